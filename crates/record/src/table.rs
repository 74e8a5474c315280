//! Tables of text. A column is as wide as its widest cell, so that a table fits the 80 columns of a usual terminal
//! whenever its content does.

use std::ops::Range;

use crate::style::{BAD, paint};

/// A cell.
#[derive(Clone, Debug, Default)]
pub struct Cell {
    text: String,
    bad: bool,
}

impl Cell {
    /// A cell that stands out if it is `bad`.
    pub fn new(value: impl ToString, bad: bool) -> Cell {
        Cell { text: value.to_string(), bad }
    }

    /// A plain cell.
    pub fn plain(value: impl ToString) -> Cell {
        Cell::new(value, false)
    }
}

/// A table.
#[derive(Clone, Debug)]
pub struct Table {
    /// The columns that end at their right, as numbers do.
    right: Range<usize>,
    /// Between two columns.
    gap: &'static str,
    rows: Vec<Vec<Cell>>,
}

impl Table {
    /// A table without rows.
    pub fn new(titles: &[&str], right: Range<usize>, gap: &'static str) -> Table {
        Table { right, gap, rows: vec![titles.iter().map(Cell::plain).collect()] }
    }

    /// Adds a row, a cell for each title.
    pub fn row(&mut self, cells: Vec<Cell>) {
        self.rows.push(cells);
    }

    /// The titles and the rows, a line each; `styled` with escape sequences for colours.
    pub fn lines(&self, styled: bool) -> Vec<String> {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            cells.map(|cell| cell.text.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..columns).map(width).collect();
        let line = |row: &Vec<Cell>| {
            let mut line = String::new();
            for (column, (cell, width)) in row.iter().zip(&widths).enumerate() {
                let padding = " ".repeat(width - cell.text.chars().count());
                let text = paint(&cell.text, BAD, styled && cell.bad);
                let between = if column == 0 { "" } else { self.gap };
                line += between;
                line += &if self.right.contains(&column) { padding + &text } else { text + &padding };
            }
            line.trim_end().to_owned()
        };
        self.rows.iter().map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_column_is_as_wide_as_its_widest_cell() {
        let mut table = Table::new(&["drive", "sent", "x"], 1..3, "  ");
        table.row(vec![Cell::plain("a"), Cell::new(12345, true), Cell::default()]);
        assert_eq!(table.lines(false), ["drive   sent  x", "a      12345"]);
        assert_eq!(table.lines(true)[1], "a      \u{1b}[1m\u{1b}[31m12345\u{1b}[0m");
    }
}
