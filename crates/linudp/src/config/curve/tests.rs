//! Curves as files: the sample, and every mistake. Any text, and whatever a drive may hold, are those of the fuzz
//! target `files`.

use super::*;

const SAMPLE: &str = include_str!("../../../files/linmot-curve.csv");

/// What of [`CURVE`] becomes what (`;;` is a line end), and in the next line what is said about it.
const MISTAKES: &str = include_str!("mistakes.txt");

const CURVE: &str = "\
# id = 5
# name = \"lift\"
# kind = \"time\"
# length = 200
time_ms,position_mm
0,0
50,0.57
100,12.5
150,-0.0001
200,0
";

fn read(text: &str) -> Curve {
    parse(text, "c.csv").unwrap_or_else(|errors| panic!("{errors}"))
}

fn same(curve: &Curve) {
    let text = to_text(curve).unwrap();
    assert_eq!(&read(&text), curve, "{text}");
}

#[test]
fn a_file_says_what_the_drive_holds() {
    let curve = Curve {
        id: 5,
        kind: CurveKind::Time,
        name: Curve::name_bytes("lift").unwrap(),
        x_length: 20_000,
        x_dimension: Dimension::TIME,
        y_dimension: Dimension::POSITION,
        wizard: 0,
        wizard_parameters: [0; 7],
        setpoints: vec![0, 5_700, 125_000, -1, 0],
    };
    assert_eq!(read(CURVE), curve);
    assert_eq!(to_text(&curve).as_deref(), Ok(CURVE));
    // As spreadsheets write it.
    let text = format!("\u{feff}{}\r\n\r\n", CURVE.replace('\n', "\r\n").replace(',', " , "));
    assert_eq!(read(&text), curve);
    let curve = Curve {
        kind: CurveKind::Cam,
        x_dimension: Dimension::ENCODER,
        y_dimension: Dimension(7),
        wizard: 3,
        wizard_parameters: [u32::MAX, 0, 0, 0, 0, 0, 1],
        name: Curve::name_bytes("\"a\" \\").unwrap(),
        ..curve
    };
    let text = to_text(&curve).unwrap();
    assert!(
        text.ends_with("encoder_counts,y_raw\n0,0\n5000,5700\n10000,125000\n15000,-1\n20000,0\n"),
        "{text}"
    );
    same(&curve);
    // Bytes that are no name, as a drive may hold them.
    let mut curve = curve;
    curve.name[3..6].copy_from_slice(b"\0\xF6x");
    let text = to_text(&curve).unwrap();
    assert!(text.contains("\n# name_bytes = [34, 97, 34, 0, 246, 120, 0, "), "{text}");
    same(&curve);
    assert_eq!(to_text(&Curve { id: 0, ..curve }), Err(CurveError::Id(0)));
}

#[test]
fn the_sample_is_a_lift() {
    let curve = read(SAMPLE);
    assert_eq!((curve.id, curve.name(), curve.setpoints.len()), (1, Some("lift"), 21));
    // 10 us, 0.1 um.
    assert_eq!((curve.x_length, curve.position_at(20_000.0)), (40_000, 400_000.0));
    same(&curve);
    assert_eq!(load("files/linmot-curve.csv"), Ok(curve));
    assert_eq!(
        load("rt-config/none.csv").unwrap_err().to_string(),
        "cannot read rt-config/none.csv: No such file or directory; name a curve, for example \
         rt-config/linmot-curve.csv"
    );
}

#[test]
fn every_mistake_says_where_it_is_and_what_would_be_right() {
    let mut lines = MISTAKES.lines();
    let mut cases = 0;
    while let (Some(change), Some(expected)) = (lines.next(), lines.next()) {
        let (from, to) = change.split_once(" => ").unwrap();
        let [from, to] = [from, to].map(|part| part.replace(";;", "\n").replace("(nothing)", ""));
        assert!(CURVE.contains(&from), "{from}");
        match parse(&CURVE.replacen(&from, &to, 1), "c.csv") {
            Ok(curve) => panic!("{change} is accepted: {curve:?}"),
            Err(errors) => {
                assert_eq!(errors.to_string(), format!("c.csv:{}", expected.trim_start()), "{change}")
            }
        }
        cases += 1;
    }
    assert!(cases > 20);
    for nothing in ["", "\n\n", "# id = 5\n"] {
        let error = parse(nothing, "c.csv").unwrap_err().to_string();
        assert_eq!(error, "c.csv has no rows; a curve has a head, a line of columns and its setpoints");
    }
}

#[test]
fn a_long_file_of_mistakes_is_a_short_list() {
    let text = CURVE.replacen("0,0\n", &"0;0\n".repeat(1_000), 1);
    assert_eq!(parse(&text, "c.csv").unwrap_err().iter().count(), MOST_MISTAKES);
    let text = CURVE.replacen("0,0\n", &"0,0\n".repeat(65_536), 1);
    assert_eq!(
        parse(&text, "c.csv").unwrap_err().to_string(),
        "c.csv:65541: row = 0,0: is one too many; a curve has at most 65535 setpoints"
    );
}
