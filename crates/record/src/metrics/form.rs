//! The two forms of the page: OpenMetrics 1.0, which the library writes, for those who ask for it, and the text format
//! 0.0.4 of Prometheus for everybody else, as the specification of OpenMetrics has it (negotiation of the protocol).

use std::fmt::Write;

/// A form of the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// Version 0.0.4.
    Text,
    /// Version 1.0.0.
    OpenMetrics,
}

impl Form {
    /// That of a request with these headers Accept: OpenMetrics, if it is named at least as much as the other one.
    pub(super) fn of_accepted<'a>(headers: impl Iterator<Item = &'a [u8]>) -> Form {
        let (mut metrics, mut text) = (0.0, 0.0);
        for range in headers.filter_map(|value| str::from_utf8(value).ok()).flat_map(|value| value.split(','))
        {
            let mut parts = range.split(';').map(str::trim);
            let kind = parts.next().unwrap_or_default().to_ascii_lowercase();
            let (mut weight, mut is_ours) = (1.0_f64, true);
            for (key, value) in parts.filter_map(|part| part.split_once('=')) {
                let value = value.trim().trim_matches('"');
                match key.trim().to_ascii_lowercase().as_str() {
                    "q" => weight = value.parse().unwrap_or(0.0),
                    "version" => is_ours = matches!((kind.as_str(), value), ("text/plain", _) | (_, "1.0.0")),
                    _ => {}
                }
            }
            let best = match kind.as_str() {
                "application/openmetrics-text" if is_ours => &mut metrics,
                "text/plain" => &mut text,
                _ => continue,
            };
            *best = weight.max(*best);
        }
        if metrics > 0.0 && metrics >= text { Form::OpenMetrics } else { Form::Text }
    }

    pub(super) fn content_type(self) -> &'static str {
        match self {
            Form::Text => "text/plain; version=0.0.4; charset=utf-8",
            Form::OpenMetrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
        }
    }

    /// A page of OpenMetrics in this form.
    pub(super) fn of(self, page: String) -> String {
        if self == Form::OpenMetrics { page } else { text(&page) }
    }
}

/// In 0.0.4 a family has the name of its samples, there are no units and no types beyond four, and nothing marks the
/// end.
fn text(page: &str) -> String {
    let (mut text, mut help) = (String::with_capacity(page.len()), None);
    for line in page.lines() {
        if line == "# EOF" || line.starts_with("# UNIT ") {
            continue;
        }
        if let Some(rest) = line.strip_prefix("# HELP ") {
            help = rest.split_once(' ').map(|(_, help)| help);
            continue;
        }
        // Writing into a string cannot fail.
        let _ = match line.strip_prefix("# TYPE ").and_then(|rest| rest.split_once(' ')) {
            None => writeln!(text, "{line}"),
            Some((family, kind)) => {
                let (behind, kind) = match kind {
                    "counter" => ("_total", "counter"),
                    "info" => ("_info", "gauge"),
                    "unknown" => ("", "untyped"),
                    other => ("", other),
                };
                if let Some(help) = help.take() {
                    let _ = writeln!(text, "# HELP {family}{behind} {help}");
                }
                writeln!(text, "# TYPE {family}{behind} {kind}")
            }
        };
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn open_metrics_is_served_on_request_only() {
        let form = |accepted: &[&str]| Form::of_accepted(accepted.iter().map(|value| value.as_bytes()));
        let prometheus = "application/openmetrics-text;version=1.0.0;q=0.5,application/openmetrics-text;\
                          version=0.0.1;q=0.4,text/plain;version=0.0.4;q=0.3,*/*;q=0.2";
        for accepted in [
            &[prometheus][..],
            &["application/openmetrics-text; version=1.0.0; charset=utf-8"],
            &["text/html", "Application/OpenMetrics-Text"],
            &["text/plain, application/openmetrics-text"],
        ] {
            assert_eq!(form(accepted), Form::OpenMetrics, "{accepted:?}");
        }
        for accepted in [
            &[][..],
            &["*/*"],
            &["text/plain;version=0.0.4"],
            &["application/openmetrics-text;version=0.0.1"],
            &["application/openmetrics-text;q=0"],
            &["application/openmetrics-text;q=0.2,text/plain;q=0.3"],
            &["application/openmetrics-text;q=x"],
            &["text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"],
            &[",;=,,q"],
        ] {
            assert_eq!(form(accepted), Form::Text, "{accepted:?}");
        }
        assert_eq!(Form::of_accepted([&b"\xFF"[..]].into_iter()), Form::Text);
    }

    #[test]
    fn a_page_of_0_0_4_has_its_families_by_the_names_of_their_samples() {
        let page = "# HELP x_runs Runs.\n# TYPE x_runs counter\nx_runs_total{a=\"b\"} 3\n\
                    # HELP x_wake_seconds Wake-up.\n# TYPE x_wake_seconds histogram\n# UNIT x_wake_seconds seconds\n\
                    x_wake_seconds_bucket{le=\"+Inf\"} 1\n\
                    # HELP x_host The host.\n# TYPE x_host info\nx_host_info{k=\"v\"} 1\n# EOF\n";
        let expected = "# HELP x_runs_total Runs.\n# TYPE x_runs_total counter\nx_runs_total{a=\"b\"} 3\n\
                        # HELP x_wake_seconds Wake-up.\n# TYPE x_wake_seconds histogram\n\
                        x_wake_seconds_bucket{le=\"+Inf\"} 1\n\
                        # HELP x_host_info The host.\n# TYPE x_host_info gauge\nx_host_info{k=\"v\"} 1\n";
        assert_eq!(Form::Text.of(page.into()), expected);
        assert_eq!(Form::OpenMetrics.of(page.into()), page);
    }
}
