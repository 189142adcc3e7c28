//! Tables as Parquet files.
//!
//! A file has row groups of whole columns in the encoding PLAIN, without compression or dictionaries, so equal tables are equal
//! files, and no column can hold more than the file is long. Only such files are read back: what a file claims is checked
//! against its length before it is decoded.

use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use parquet::basic::{ConvertedType, Encoding, LogicalType, Repetition, Type as Physical};
use parquet::column::page::Page;
use parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use parquet::data_type::{ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::{Type, TypePtr};

use super::table::{Cells, Column, Kind, Table};
use crate::files::input_file;
use crate::system::panics::caught;

/// Why a table cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    #[error("{file}: {source}")]
    Read { file: String, source: std::io::Error },
    #[error("{file}: is no table of a study: {reason}")]
    Unreadable { file: String, reason: String },
    #[error("cannot write the table: {0}")]
    Write(String),
}

impl From<ParquetError> for TableError {
    fn from(error: ParquetError) -> Self {
        Self::Write(error.to_string())
    }
}

/// Definition levels: of a cell that is missing, of one that is there (of a list: without entries), of an entry of a list.
const MISSING: i16 = 0;
const THERE: i16 = 1;
const ENTRY: i16 = 2;

/// With which every file begins.
const MAGIC: &[u8] = b"PAR1";
/// Most columns of a file that is read.
const MOST_COLUMNS: usize = 4096;

/// A file that is written one group of rows at a time.
pub struct Writer {
    file: SerializedFileWriter<Vec<u8>>,
}

impl Writer {
    /// A file with these columns, and with `metadata` as keys and values.
    ///
    /// # Errors
    /// [`TableError::Write`].
    pub fn new(columns: &[Column], metadata: &[(String, String)]) -> Result<Self, TableError> {
        let keys = metadata.iter().map(|(key, value)| KeyValue::new(key.clone(), value.clone())).collect();
        let properties = WriterProperties::builder()
            .set_created_by(concat!("squealcast ", env!("CARGO_PKG_VERSION")).to_owned())
            .set_dictionary_enabled(false)
            .set_statistics_enabled(EnabledStatistics::None)
            .set_offset_index_disabled(true)
            .set_key_value_metadata(Some(keys))
            .build();
        Ok(Self { file: SerializedFileWriter::new(vec![], schema(columns)?, Arc::new(properties))? })
    }

    /// Adds the rows of a table as one group.
    ///
    /// # Errors
    /// [`TableError::Write`].
    pub fn write(&mut self, table: &Table) -> Result<(), TableError> {
        let mut group = self.file.next_row_group()?;
        for (_, cells) in table.cells() {
            write_column(&mut group, cells)?;
        }
        group.close()?;
        Ok(())
    }

    /// The bytes of the file.
    ///
    /// # Errors
    /// [`TableError::Write`].
    pub fn finish(self) -> Result<Vec<u8>, TableError> {
        Ok(self.file.into_inner()?)
    }
}

fn schema(columns: &[Column]) -> Result<TypePtr, ParquetError> {
    let fields = columns.iter().map(|column| field(column).map(Arc::new)).collect::<Result<_, _>>()?;
    Ok(Arc::new(Type::group_type_builder("study").with_fields(fields).build()?))
}

fn field(column: &Column) -> Result<Type, ParquetError> {
    let plain = |physical| Type::primitive_type_builder(&column.name, physical).with_repetition(Repetition::OPTIONAL);
    match column.kind {
        Kind::Whole => plain(Physical::INT64).build(),
        Kind::Number => plain(Physical::DOUBLE).build(),
        Kind::Text => plain(Physical::BYTE_ARRAY).with_logical_type(Some(LogicalType::String)).build(),
        Kind::List => {
            let element = Type::primitive_type_builder("element", Physical::DOUBLE)
                .with_repetition(Repetition::REQUIRED)
                .build()?;
            let list = Type::group_type_builder("list")
                .with_repetition(Repetition::REPEATED)
                .with_fields(vec![Arc::new(element)])
                .build()?;
            Type::group_type_builder(&column.name)
                .with_repetition(Repetition::OPTIONAL)
                .with_logical_type(Some(LogicalType::List))
                .with_converted_type(ConvertedType::LIST)
                .with_fields(vec![Arc::new(list)])
                .build()
        }
    }
}

fn write_column(group: &mut SerializedRowGroupWriter<'_, Vec<u8>>, cells: &Cells) -> Result<(), TableError> {
    match cells {
        Cells::Whole(cells) => write_cells::<Int64Type, i64>(group, cells, |whole| *whole),
        Cells::Number(cells) => write_cells::<DoubleType, f64>(group, cells, |number| *number),
        Cells::Text(cells) => write_cells::<ByteArrayType, String>(group, cells, |text| text.as_str().into()),
        Cells::List(cells) => {
            let (mut values, mut levels, mut repeated) = (vec![], vec![], vec![]);
            for cell in cells {
                let entries = cell.as_deref().unwrap_or_default();
                if entries.is_empty() {
                    levels.push(if cell.is_some() { THERE } else { MISSING });
                    repeated.push(0);
                }
                levels.extend(entries.iter().map(|_| ENTRY));
                repeated.extend((0..entries.len()).map(|k| i16::from(k > 0)));
                values.extend_from_slice(entries);
            }
            write_values::<DoubleType>(group, &values, &levels, Some(&repeated))
        }
    }
}

fn write_cells<T: DataType, C>(
    group: &mut SerializedRowGroupWriter<'_, Vec<u8>>,
    cells: &[Option<C>],
    value: impl Fn(&C) -> T::T,
) -> Result<(), TableError> {
    let values: Vec<T::T> = cells.iter().flatten().map(value).collect();
    let levels: Vec<i16> = cells.iter().map(|cell| if cell.is_some() { THERE } else { MISSING }).collect();
    write_values::<T>(group, &values, &levels, None)
}

fn write_values<T: DataType>(
    group: &mut SerializedRowGroupWriter<'_, Vec<u8>>,
    values: &[T::T],
    levels: &[i16],
    repeated: Option<&[i16]>,
) -> Result<(), TableError> {
    let missing = || TableError::Write("more columns than the table has".to_owned());
    let mut column = group.next_column()?.ok_or_else(missing)?;
    column.typed::<T>().write_batch(values, Some(levels), repeated)?;
    Ok(column.close()?)
}

/// A file that is read column by column.
pub struct Reader {
    file: SerializedFileReader<Bytes>,
    name: String,
    columns: Vec<Column>,
    rows: usize,
    bytes: usize,
}

impl Reader {
    /// Opens the file at `path`, of at most [`input_file::STUDY_TABLE`] bytes.
    ///
    /// # Errors
    /// [`TableError::Read`], [`TableError::Unreadable`].
    pub fn open(path: &Path) -> Result<Self, TableError> {
        let name = path.display().to_string();
        match input_file::read(path, input_file::STUDY_TABLE) {
            Ok(bytes) => Self::new(&name, bytes),
            Err(source) => Err(TableError::Read { file: name, source }),
        }
    }

    /// Opens the file of these bytes; `name` is for errors.
    ///
    /// # Errors
    /// [`TableError::Unreadable`].
    pub fn new(name: &str, bytes: Vec<u8>) -> Result<Self, TableError> {
        let length = bytes.len();
        if !bytes.starts_with(MAGIC) {
            return Err(TableError::Unreadable { file: name.to_owned(), reason: "it is no Parquet file".to_owned() });
        }
        let file = guarded(name, || SerializedFileReader::new(Bytes::from(bytes)))?;
        let refuse = |reason: String| TableError::Unreadable { file: name.to_owned(), reason };
        let metadata = file.metadata();
        let fields = metadata.file_metadata().schema().get_fields();
        if fields.len() > MOST_COLUMNS {
            return Err(refuse(format!("it has {} columns, expected at most {MOST_COLUMNS}", fields.len())));
        }
        let columns = fields.iter().map(|field| column_of(field).map_err(refuse)).collect::<Result<Vec<_>, _>>()?;
        let mut rows = 0_usize;
        for group in metadata.row_groups() {
            rows = rows.saturating_add(usize::try_from(group.num_rows()).unwrap_or(usize::MAX));
            if group.num_columns() != columns.len() {
                return Err(refuse("a group of rows lacks columns".to_owned()));
            }
        }
        // Every row has the number of its case, of 8 bytes.
        if rows > length {
            return Err(refuse(format!("it claims {rows} rows in {length} bytes")));
        }
        Ok(Self { file, name: name.to_owned(), columns, rows, bytes: length })
    }

    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The value of a key of the metadata.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        let keys = self.file.metadata().file_metadata().key_value_metadata()?;
        keys.iter().find(|own| own.key == key)?.value.as_deref()
    }

    /// Reads the columns with these names, in this order; those it does not have are left out.
    ///
    /// # Errors
    /// [`TableError::Unreadable`].
    pub fn read(&self, names: &[&str]) -> Result<Table, TableError> {
        let known = names.iter().filter_map(|name| self.columns.iter().position(|column| column.name == *name));
        let mut cells = vec![];
        for index in known {
            let column = &self.columns[index];
            cells.push((column.name.clone(), guarded(&self.name, || self.column(index, column.kind))?));
        }
        let unequal =
            || TableError::Unreadable { file: self.name.clone(), reason: "columns differ in length".to_owned() };
        Table::of(cells).ok_or_else(unequal)
    }

    /// Reads all columns.
    ///
    /// # Errors
    /// [`TableError::Unreadable`].
    pub fn read_all(&self) -> Result<Table, TableError> {
        self.read(&self.columns.iter().map(|column| column.name.as_str()).collect::<Vec<_>>())
    }

    fn column(&self, index: usize, kind: Kind) -> Result<Cells, ParquetError> {
        let mut levels = Levels { most: self.bytes, is_list: kind == Kind::List, ..Levels::default() };
        let wrong = || ParquetError::General("a column has another type than its field".to_owned());
        match kind {
            Kind::Whole => {
                let values = self.values(index, &mut levels, |reader| match reader {
                    ColumnReader::Int64ColumnReader(reader) => Ok(reader),
                    _ => Err(wrong()),
                })?;
                Ok(Cells::Whole(levels.cells(values)?))
            }
            Kind::Number => {
                let values = self.values(index, &mut levels, doubles)?;
                Ok(Cells::Number(levels.cells(values)?))
            }
            Kind::Text => {
                let values: Vec<ByteArray> = self.values(index, &mut levels, |reader| match reader {
                    ColumnReader::ByteArrayColumnReader(reader) => Ok(reader),
                    _ => Err(wrong()),
                })?;
                let texts = values.iter().map(|text| text.as_utf8().map(str::to_owned)).collect::<Result<_, _>>()?;
                Ok(Cells::Text(levels.cells(texts)?))
            }
            Kind::List => {
                let values = self.values(index, &mut levels, doubles)?;
                Ok(Cells::List(levels.lists(&values)?))
            }
        }
    }

    /// The values of a column that are there, of all groups of rows; `levels` receives which cells are.
    fn values<T: DataType>(
        &self,
        index: usize,
        levels: &mut Levels,
        typed: impl Fn(ColumnReader) -> Result<ColumnReaderImpl<T>, ParquetError>,
    ) -> Result<Vec<T::T>, ParquetError> {
        let mut values = vec![];
        for group in 0..self.file.num_row_groups() {
            let group = self.file.get_row_group(group)?;
            let rows = usize::try_from(group.metadata().num_rows()).unwrap_or(0);
            let mut claimed = 0_usize;
            let mut pages = group.get_column_page_reader(index)?;
            while let Some(page) = pages.get_next_page()? {
                claimed = claimed.saturating_add(values_of(&page)?);
                levels.check(claimed)?;
            }
            let mut reader = typed(group.get_column_reader(index)?)?;
            let repeated = levels.is_list.then_some(&mut levels.repeated);
            let (read, _, _) = reader.read_records(rows, Some(&mut levels.defined), repeated, &mut values)?;
            if read != rows {
                return Err(ParquetError::General(format!("a column has {read} of {rows} rows")));
            }
            levels.check(levels.defined.len())?;
        }
        Ok(values)
    }
}

fn doubles(reader: ColumnReader) -> Result<ColumnReaderImpl<DoubleType>, ParquetError> {
    match reader {
        ColumnReader::DoubleColumnReader(reader) => Ok(reader),
        _ => Err(ParquetError::General("a column has another type than its field".to_owned())),
    }
}

/// Definition and repetition levels of a column.
#[derive(Default)]
struct Levels {
    defined: Vec<i16>,
    repeated: Vec<i16>,
    is_list: bool,
    /// Most of them: no more than the file has bytes.
    most: usize,
}

impl Levels {
    fn check(&self, values: usize) -> Result<(), ParquetError> {
        if values <= self.most {
            return Ok(());
        }
        Err(ParquetError::General(format!("a column claims {values} values in {} bytes", self.most)))
    }

    /// The cells of a column without lists.
    fn cells<T>(&self, values: Vec<T>) -> Result<Vec<Option<T>>, ParquetError> {
        let mut values = values.into_iter();
        let cells = self.defined.iter().map(|&level| if level == MISSING { None } else { values.next() }).collect();
        Ok(cells)
    }

    /// The cells of a column of lists.
    fn lists(&self, values: &[f64]) -> Result<Vec<Option<Vec<f64>>>, ParquetError> {
        let mut values = values.iter().copied();
        let mut cells: Vec<Option<Vec<f64>>> = vec![];
        for (&level, &repeated) in self.defined.iter().zip(&self.repeated) {
            if repeated == 0 {
                cells.push((level != MISSING).then(Vec::new));
            }
            if level == ENTRY {
                let broken = || ParquetError::General("a list whose entries are not there".to_owned());
                let list = cells.last_mut().and_then(Option::as_mut).ok_or_else(broken)?;
                list.push(values.next().ok_or_else(broken)?);
            }
        }
        Ok(cells)
    }
}

/// The number of values that a page claims, if it is one of ours.
fn values_of(page: &Page) -> Result<usize, ParquetError> {
    match page {
        Page::DataPage { num_values, encoding: Encoding::PLAIN, .. } => Ok(*num_values as usize),
        Page::DataPage { encoding, .. } => {
            Err(ParquetError::General(format!("a page in the encoding {encoding}, expected PLAIN")))
        }
        Page::DataPageV2 { .. } | Page::DictionaryPage { .. } => {
            Err(ParquetError::General("a page of another kind than studies have".to_owned()))
        }
    }
}

/// The column that a field of the schema is.
fn column_of(field: &Type) -> Result<Column, String> {
    let name = field.name();
    let columns = Kind::ALL.map(|kind| Column::new(name, kind));
    let same = |column: &Column| self::field(column).is_ok_and(|own| own == *field);
    columns.into_iter().find(same).ok_or_else(|| format!("column `{name}` has a type that no column of a study has"))
}

/// The result of a work of the library, whose panics on damaged files become errors.
fn guarded<T>(name: &str, work: impl FnOnce() -> Result<T, ParquetError>) -> Result<T, TableError> {
    let refuse = |reason: String| TableError::Unreadable { file: name.to_owned(), reason };
    match caught(work) {
        Ok(done) => done.map_err(|error| refuse(error.to_string())),
        Err(_) => Err(refuse("it is damaged".to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::super::table::Cell;
    use super::*;

    fn table() -> Table {
        let columns = [
            Column::new("case", Kind::Whole),
            Column::new("load_n", Kind::Number),
            Column::new("status", Kind::Text),
            Column::new("frequencies_hz", Kind::List),
        ];
        let mut table = Table::new(&columns);
        let row = |case, load, text: &str, list: Cell| vec![Cell::Whole(case), load, Cell::Text(text.to_owned()), list];
        table.push(row(0, Cell::Number(1.5), "done", Cell::List(vec![1.0, f64::INFINITY, 3.0])));
        table.push(row(1, Cell::Missing, "fäiled", Cell::Missing));
        table.push(row(2, Cell::Number(-0.0), "", Cell::List(vec![])));
        table.push(row(3, Cell::Number(4.0), "done", Cell::List(vec![7.0])));
        table
    }

    fn written(tables: &[Table]) -> Vec<u8> {
        let mut writer = Writer::new(&tables[0].columns(), &[("study".to_owned(), "a = 1\n".to_owned())]).unwrap();
        tables.iter().for_each(|table| writer.write(table).unwrap());
        writer.finish().unwrap()
    }

    #[test]
    fn a_table_is_read_as_it_was_written_and_equal_tables_are_equal_files() {
        let bytes = written(&[table(), table()]);
        assert_eq!(bytes, written(&[table(), table()]));
        let reader = Reader::new("a.parquet", bytes).unwrap();
        assert_eq!((reader.rows(), reader.columns()), (8, &table().columns()[..]));
        assert_eq!((reader.metadata("study"), reader.metadata("none")), (Some("a = 1\n"), None));
        let mut twice = table();
        twice.append(table());
        assert_eq!(reader.read_all().unwrap(), twice);
        let some = reader.read(&["status", "none", "case"]).unwrap();
        assert_eq!(some.columns(), [Column::new("status", Kind::Text), Column::new("case", Kind::Whole)]);
        assert_eq!(Reader::new("a", written(&[Table::new(&table().columns())])).unwrap().rows(), 0);
    }

    #[test]
    fn what_is_no_table_of_a_study_is_refused() {
        let why = |bytes: &[u8]| Reader::new("a.parquet", bytes.to_vec()).err().unwrap().to_string();
        assert!(why(b"").starts_with("a.parquet: is no table of a study: "), "{}", why(b""));
        let bytes = written(&[table()]);
        why(&bytes[..bytes.len() - 1]);
        why(&bytes[1..]);
    }
}
