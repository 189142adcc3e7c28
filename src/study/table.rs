//! Tables: named columns of equal length, each of one kind. Any cell may be missing.

use crate::msgs::listed;

listed! {
    /// What the cells of a column hold.
    pub enum Kind {
        Whole,
        Number,
        Text,
        /// A list of numbers.
        List,
    }
}

/// Name and kind of a column.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Column {
    pub name: String,
    pub kind: Kind,
}

impl Column {
    pub fn new(name: &str, kind: Kind) -> Self {
        Self { name: name.to_owned(), kind }
    }
}

/// A cell.
#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    Missing,
    Whole(i64),
    Number(f64),
    Text(String),
    List(Vec<f64>),
}

impl Cell {
    /// A number, or nothing.
    pub fn maybe(value: Option<f64>) -> Self {
        value.map_or(Self::Missing, Self::Number)
    }

    /// A count.
    pub fn count(count: usize) -> Self {
        Self::Whole(count as i64)
    }
}

/// The cells of a column.
#[derive(Clone, Debug, PartialEq)]
pub enum Cells {
    Whole(Vec<Option<i64>>),
    Number(Vec<Option<f64>>),
    Text(Vec<Option<String>>),
    List(Vec<Option<Vec<f64>>>),
}

impl Cells {
    fn none(kind: Kind) -> Self {
        match kind {
            Kind::Whole => Self::Whole(vec![]),
            Kind::Number => Self::Number(vec![]),
            Kind::Text => Self::Text(vec![]),
            Kind::List => Self::List(vec![]),
        }
    }

    fn push(&mut self, cell: Cell) {
        match (self, cell) {
            (Self::Whole(cells), Cell::Whole(whole)) => cells.push(Some(whole)),
            (Self::Number(cells), Cell::Number(number)) => cells.push(Some(number)),
            (Self::Text(cells), Cell::Text(text)) => cells.push(Some(text)),
            (Self::List(cells), Cell::List(list)) => cells.push(Some(list)),
            (Self::Whole(cells), Cell::Missing) => cells.push(None),
            (Self::Number(cells), Cell::Missing) => cells.push(None),
            (Self::Text(cells), Cell::Missing) => cells.push(None),
            (Self::List(cells), Cell::Missing) => cells.push(None),
            (cells, cell) => panic!("a {cell:?} in a column of {:?}", cells.kind()),
        }
    }

    fn append(&mut self, other: Self) {
        match (self, other) {
            (Self::Whole(cells), Self::Whole(others)) => cells.extend(others),
            (Self::Number(cells), Self::Number(others)) => cells.extend(others),
            (Self::Text(cells), Self::Text(others)) => cells.extend(others),
            (Self::List(cells), Self::List(others)) => cells.extend(others),
            (cells, others) => panic!("{:?} after {:?}", others.kind(), cells.kind()),
        }
    }

    pub fn kind(&self) -> Kind {
        match self {
            Self::Whole(_) => Kind::Whole,
            Self::Number(_) => Kind::Number,
            Self::Text(_) => Kind::Text,
            Self::List(_) => Kind::List,
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Whole(cells) => cells.len(),
            Self::Number(cells) => cells.len(),
            Self::Text(cells) => cells.len(),
            Self::List(cells) => cells.len(),
        }
    }

    /// The cells as numbers; `None` of a column that has none.
    pub fn numbers(&self) -> Option<Vec<Option<f64>>> {
        match self {
            Self::Whole(cells) => Some(cells.iter().map(|cell| cell.map(|whole| whole as f64)).collect()),
            Self::Number(cells) => Some(cells.clone()),
            Self::Text(_) | Self::List(_) => None,
        }
    }
}

/// A table.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    columns: Vec<(String, Cells)>,
}

impl Table {
    /// A table without rows.
    pub fn new(columns: &[Column]) -> Self {
        Self { columns: columns.iter().map(|column| (column.name.clone(), Cells::none(column.kind))).collect() }
    }

    /// The table of these columns; `None` if they differ in length.
    pub fn of(columns: Vec<(String, Cells)>) -> Option<Self> {
        let equal = columns.windows(2).all(|pair| pair[0].1.len() == pair[1].1.len());
        equal.then_some(Self { columns })
    }

    pub fn rows(&self) -> usize {
        self.columns.first().map_or(0, |(_, cells)| cells.len())
    }

    pub fn columns(&self) -> Vec<Column> {
        self.columns.iter().map(|(name, cells)| Column::new(name, cells.kind())).collect()
    }

    /// Names and cells of all columns.
    pub fn cells(&self) -> &[(String, Cells)] {
        &self.columns
    }

    pub fn column(&self, name: &str) -> Option<&Cells> {
        self.columns.iter().find(|(own, _)| own == name).map(|(_, cells)| cells)
    }

    /// Adds a row.
    ///
    /// # Panics
    /// If it does not have a cell of the right kind for each column.
    pub fn push(&mut self, row: Vec<Cell>) {
        assert_eq!(row.len(), self.columns.len(), "a cell for each column");
        self.columns.iter_mut().zip(row).for_each(|((_, cells), cell)| cells.push(cell));
    }

    /// Adds the rows of a table with the same columns.
    ///
    /// # Panics
    /// If it has others.
    pub fn append(&mut self, other: Self) {
        assert_eq!(self.columns(), other.columns(), "the same columns");
        self.columns.iter_mut().zip(other.columns).for_each(|((_, cells), (_, others))| cells.append(others));
    }

    /// The columns with these names, in this order; those it does not have are left out.
    pub fn only(mut self, names: &[&str]) -> Self {
        let mut taken = vec![];
        for name in names {
            if let Some(position) = self.columns.iter().position(|(own, _)| own == name) {
                taken.push(self.columns.swap_remove(position));
            }
        }
        Self { columns: taken }
    }
}
