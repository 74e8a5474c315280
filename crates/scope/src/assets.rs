//! The files of the page, built into the program: it needs no network.

/// A file: its name, its type, and its bytes.
type Asset = (&'static str, &'static str, &'static [u8]);

const HTML: &str = "text/html; charset=utf-8";
const STYLE: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const IMAGE: &str = "image/svg+xml";
const TEXT: &str = "text/plain; charset=utf-8";

macro_rules! assets {
    ($($name:literal: $kind:ident,)+) => {
        [$(($name, $kind, include_bytes!(concat!("assets/", $name)) as &[u8]),)+]
    };
}

const ASSETS: &[Asset] = &assets! {
    "index.html": HTML,
    "icon.svg": IMAGE,
    "style.css": STYLE,
    "main.js": SCRIPT,
    "token.js": SCRIPT,
    "link.js": SCRIPT,
    "layout.js": SCRIPT,
    "cursors.js": SCRIPT,
    "store.js": SCRIPT,
    "trigger.js": SCRIPT,
    "view.js": SCRIPT,
    "plot.js": SCRIPT,
    "panel.js": SCRIPT,
    "operate.js": SCRIPT,
    "export.js": SCRIPT,
    "mcap.js": SCRIPT,
    "uplot.min.js": SCRIPT,
    "uplot.min.css": STYLE,
    "uplot.LICENSE": TEXT,
};

/// The type and the bytes of a file; the empty name is the page.
pub fn find(name: &str) -> Option<(&'static str, &'static [u8])> {
    let name = if name.is_empty() { "index.html" } else { name };
    ASSETS.iter().find(|(known, ..)| *known == name).map(|(_, kind, bytes)| (*kind, *bytes))
}
