//! Tables as files: what a drive holds next to its commands, and every mistake. Any text, and whatever a drive may
//! hold, are those of the fuzz target `files`.

use super::*;
use crate::motion::{Bits, MotionCommand};

/// The keys of an entry (`;;` is a line end), and in the next line what is said about them.
const MISTAKES: &str = include_str!("mistakes.txt");

fn read(text: &str) -> table::Table {
    parse(text, "t.toml").unwrap_or_else(|errors| panic!("{errors}"))
}

fn id(id: u16) -> EntryId {
    EntryId::new(id).unwrap()
}

fn same(table: &table::Table) {
    let text = to_text(table);
    assert_eq!(&read(&text), table, "{text}");
    assert_eq!(to_text(&read(&text)), text, "it is stable");
}

#[test]
fn what_a_drive_holds_beside_the_sense_of_it_stays() {
    let mut table = table::Table::new();
    same(&table);
    let command = MotionCommand::if_status_word_equal(Bits(0x0400), Bits(0x0400), id(1), id(2));
    let mut entry = Entry::new("a \"b\" \\ c", command, None).unwrap();
    table.insert(id(1), entry);
    entry.parameters[30] = 7;
    entry.reserved[9] = 1;
    entry.header |= 5;
    entry.name[15] = b'x';
    table.insert(id(2), entry);
    let text = to_text(&table);
    let expected = "[[entry]]\nid = 2\n\
         name_bytes = [97, 32, 34, 98, 34, 32, 92, 32, 99, 0, 0, 0, 0, 0, 0, 120]\n\
         command = \"if-status-word-equal\"\nmask = 0x0400\nvalue = 0x0400\nif_true = 1\nif_false = 2\n\
         unused = [0x0000, 0x0000, 0x0000, 0x0000, 0x0000, 0x0000, 0x0000, 0x0000, 0x0000, 0x0000, 0x0000, \
         0x0007]\ncount = 5\nreserved = [0, 0, 0, 0, 0, 0, 0, 0, 0, 1]\n";
    assert!(text.ends_with(expected), "{text}");
    same(&table);
    // Entries that are not there, and ids that are none.
    entry.parameters[4] = 0;
    entry.next = Some(0);
    table.insert(id(3), entry);
    assert!(to_text(&table).contains("incomplete = true"));
    assert!(to_text(&table).contains("command = 0x264\nparameters = [0x0400, 0x0400, 0x0000, 0x0002,"));
    same(&table);
}

#[test]
fn keys_of_an_entry_are_no_fields() {
    let own = ["id", "name", "command", "next", "parameters", "unused", "name_bytes", "reserved", "count"];
    for info in CATALOGUE {
        assert!(info.fields.iter().all(|field| !own.contains(&field.name)), "{}", info.name);
    }
}

#[test]
fn every_mistake_says_where_it_is_and_what_would_be_right() {
    let mut lines = MISTAKES.lines();
    let mut cases = 0;
    while let (Some(entry), Some(expected)) = (lines.next(), lines.next()) {
        let text = format!("[[entry]]\n{}\n", entry.replace(" ;; ", "\n"));
        match parse(&text, "t.toml") {
            Ok(table) => panic!("{entry} is accepted: {table:?}"),
            Err(errors) => {
                assert_eq!(errors.to_string(), format!("t.toml:{}", expected.trim_start()), "{entry}")
            }
        }
        cases += 1;
    }
    assert!(cases > 20);
    let missing = parse("", "t.toml").unwrap_err().to_string();
    assert_eq!(
        missing,
        "t.toml:1: entry: missing; a command table has an [[entry]] for each entry, or is entry = []"
    );
}
