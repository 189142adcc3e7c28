//! Modes of a substructure from a finite-element program, as an `.npz` archive of numpy arrays.
//!
//! Type and shape of an array are checked before its values are decompressed. Memory is allocated once, for the number
//! of values that the shape gives.

use std::io::{self, BufReader, Cursor, Read};

use faer::Mat;
use npyz::{DType, Deserialize, NpyFile, Order, TypeChar};

use super::RigError;
use super::modal_data::{ModalData, Residual};
use crate::contact::{RigidMotions, StaticResponse};
use crate::physics::ResidualFlexibility;
use crate::reduction::PartMatrices;

/// Largest total size of the arrays of one archive, bytes.
const MOST_BYTES: u64 = 1 << 30;
/// Second limit on the total size: `(factor, floor)`. The arrays may take at most `factor` times the bytes of the
/// archive, though always `floor` bytes. Real data does not compress further; a decompression bomb does.
const MOST_TIMES_ARCHIVE: (u64, u64) = (100, 64 << 20);
/// Longest accepted header of an array, bytes; numpy writes 128.
const LONGEST_HEADER: usize = 1024;
/// Largest difference of two mirrored entries of a symmetric or skew matrix, relative to its largest entry: the
/// rounding of ten printed digits.
const SYMMETRY: f64 = 1e-9;
/// Most rigid motions of free-floating parts: six of each of two parts.
const MOST_RIGID: usize = 12;

/// A numpy array in C order.
struct Array {
    shape: Vec<usize>,
    values: Vec<f64>,
}

/// Reads residual flexibility and inertia between `c` contact pairs: `flexibility_sliding` and `inertia_sliding` of
/// shape (c, c); `flexibility_normal` and `inertia_normal` of shape (c (c + 1) / 2), the lower triangles of symmetric
/// matrices by rows. Both inertia arrays may be absent.
///
/// # Errors
/// [`RigError::Npz`], [`RigError::NotFinite`].
pub fn read_pair_residual(file: &str, bytes: &[u8], c: usize) -> Result<ResidualFlexibility, RigError> {
    let mut archive = Archive::open(file, bytes)?;
    let triangle = |row: usize, column: usize| row * (row + 1) / 2 + column;
    let mut both = |kind: &str| -> Result<Option<[Mat<f64>; 2]>, RigError> {
        let names = ["normal", "sliding"].map(|direction| format!("{kind}_{direction}"));
        let shapes = [vec![triangle(c, 0)], vec![c, c]];
        let mut arrays = vec![];
        for (name, shape) in names.iter().zip(&shapes) {
            let limit = || format!("({}), by the {c} contact pairs", dimensions(shape));
            arrays.push(archive.array(name, |found| if found == shape { Ok(()) } else { Err(limit()) })?);
        }
        match (&arrays[0], &arrays[1]) {
            (None, None) => Ok(None),
            (Some(normal), Some(sliding)) => Ok(Some([
                Mat::from_fn(c, c, |i, j| normal.values[triangle(i.max(j), i.min(j))]),
                Mat::from_fn(c, c, |i, j| sliding.values[i * c + j]),
            ])),
            (None, Some(_)) => Err(refuse(file, &names[0], "is missing", "both directions")),
            (Some(_), None) => Err(refuse(file, &names[1], "is missing", "both directions")),
        }
    };
    let [normal, sliding] =
        both("flexibility")?.ok_or_else(|| refuse(file, "flexibility_normal", "is missing", "an array"))?;
    Ok(ResidualFlexibility { normal, sliding, inertia: both("inertia")? })
}

/// Reads the static response between `c` contact pairs: `flexibility_normal` and `flexibility_sliding` as
/// [`read_pair_residual`], `gap_per_load` (c), and of free-floating parts `rigid_normal` and `rigid_sliding` (c, r) and
/// `rigid_load` (r).
///
/// # Errors
/// [`RigError::Npz`], [`RigError::NotFinite`].
pub fn read_static_response(file: &str, bytes: &[u8], c: usize) -> Result<StaticResponse, RigError> {
    let ResidualFlexibility { normal, sliding, inertia: _ } = read_pair_residual(file, bytes, c)?;
    let mut archive = Archive::open(file, bytes)?;
    let mut array = |name: &str, shape: &[usize]| {
        let limit = || format!("({})", dimensions(shape));
        archive.array(name, |found| if found == shape { Ok(()) } else { Err(limit()) })
    };
    let required = |name: &str, array: Option<Array>| array.ok_or_else(|| refuse(file, name, "is missing", "an array"));
    let gap_per_load = required("gap_per_load", array("gap_per_load", &[c])?)?.values;
    let load = archive.array("rigid_load", |shape| {
        if matches!(shape, [0..=MOST_RIGID]) { Ok(()) } else { Err(format!("(r), at most {MOST_RIGID} rigid motions")) }
    })?;
    let load = load.map(|load| load.values).unwrap_or_default();
    let mut motions = |name: &str| -> Result<Mat<f64>, RigError> {
        if load.is_empty() {
            return Ok(Mat::zeros(c, 0));
        }
        let r = load.len();
        let expected = |found: &[usize]| found == [c, r];
        let array = archive
            .array(name, |found| if expected(found) { Ok(()) } else { Err(format!("({c}, {r}), by rigid_load")) })?;
        let array = required(name, array)?;
        Ok(Mat::from_fn(c, r, |i, j| array.values[i * r + j]))
    };
    let (rigid_normal, rigid_sliding) = (motions("rigid_normal")?, motions("rigid_sliding")?);
    Ok(StaticResponse {
        normal_flexibility: normal,
        sliding_flexibility: sliding,
        gap_per_load,
        rigid: RigidMotions { normal: rigid_normal, sliding: rigid_sliding, load },
    })
}

/// Reads `omega_rad_s` (i), `phi` (c, 3, i), `nodes_m` (c, 3) and the optional arrays `damping_ratio` and `load` (i),
/// `mass_share`, `damping`, `gyroscopic` and `spin` (i, i), `residual_flexibility` and `residual_inertia` (3c, 3c).
///
/// # Errors
/// [`RigError::Npz`], [`RigError::NotFinite`].
pub fn read(file: &str, bytes: &[u8]) -> Result<ModalData, RigError> {
    let mut archive = Archive::open(file, bytes)?;
    let required = |name: &str, array: Option<Array>, shape: &str| {
        array.ok_or_else(|| refuse(file, name, "is missing", &format!("an array of shape {shape}")))
    };
    let expected = |holds: bool, limit: String| if holds { Ok(()) } else { Err(limit) };
    let omega = archive.array("omega_rad_s", |shape| expected(shape.len() == 1, "(i)".to_owned()))?;
    let omega = required("omega_rad_s", omega, "(i)")?;
    let modes = omega.values.len();
    let nodes = archive.array("nodes_m", |shape| expected(matches!(shape, [_, 3]), "(c, 3)".to_owned()))?;
    let nodes = required("nodes_m", nodes, "(c, 3)")?;
    let count = nodes.shape[0];
    let phi = archive.array("phi", |shape| {
        expected(modes > 0 && count > 0, "at least one node and one mode".to_owned())?;
        expected(shape == [count, 3, modes], format!("({count}, 3, {modes}), by nodes_m and omega_rad_s"))
    })?;
    let phi = required("phi", phi, "(c, 3, i)")?;
    let damping =
        archive.array("damping_ratio", |shape| expected(shape == [modes], format!("({modes}), as omega_rad_s")))?;
    let load = archive.array("load", |shape| expected(shape == [modes], format!("({modes}), as omega_rad_s")))?;
    let mass_share = archive.array("mass_share", |shape| {
        expected(shape == [modes, modes], format!("({modes}, {modes}), by omega_rad_s"))
    })?;
    let mut square = |name: &str, sign: f64| -> Result<Option<Mat<f64>>, RigError> {
        let array = archive
            .array(name, |shape| expected(shape == [modes, modes], format!("({modes}, {modes}), by omega_rad_s")))?;
        array.map(|array| mirrored(file, name, modes, &array, sign)).transpose()
    };
    let matrices = PartMatrices {
        damping: square("damping", 1.0)?,
        gyroscopic: square("gyroscopic", -1.0)?,
        spin: square("spin", 1.0)?,
    };
    let mut residual = |name: &str| {
        let size = 3 * count;
        archive.array(name, |shape| expected(shape == [size, size], format!("({size}, {size}), by nodes_m")))
    };
    let residuals = [residual("residual_flexibility")?, residual("residual_inertia")?];
    if let Some((mode, value)) = omega.values.iter().enumerate().find(|(_, value)| **value < 0.0) {
        return Err(refuse(file, &format!("omega_rad_s[{mode}]"), &format!("is {value}"), "at least 0"));
    }
    let mass_share = mass_share.map(|share| Mat::from_fn(modes, modes, |i, j| share.values[i * modes + j]));
    let residual = symmetric_residual(file, count, residuals)?;
    let nodes_m = nodes.values.chunks_exact(3).map(|node| [node[0], node[1], node[2]]).collect();
    Ok(ModalData {
        omega_rad_s: omega.values,
        phi: phi.values,
        nodes_m,
        damping_ratio: damping.map(|damping| damping.values),
        mass_share,
        load: load.map(|load| load.values),
        matrices,
        residual,
    })
}

/// Residual flexibility and inertia between x, y and z of `count` nodes, checked for symmetry.
fn symmetric_residual(file: &str, count: usize, arrays: [Option<Array>; 2]) -> Result<Option<Residual>, RigError> {
    let names = ["residual_flexibility", "residual_inertia"];
    let symmetric = |name: &str, array: Array| -> Result<Mat<f64>, RigError> {
        let size = 3 * count;
        for row in 0..size {
            let value = array.values[row * size + row];
            if value < 0.0 {
                return Err(refuse(file, &format!("{name}[{row}, {row}]"), &format!("is {value}"), "at least 0"));
            }
        }
        mirrored(file, name, size, &array, 1.0)
    };
    match arrays {
        [None, None] => Ok(None),
        [None, Some(_)] => Err(refuse(file, names[1], "is given without residual_flexibility", "both, or neither")),
        [Some(flexibility), inertia] => Ok(Some(Residual {
            flexibility: symmetric(names[0], flexibility)?,
            inertia: inertia.map(|inertia| symmetric(names[1], inertia)).transpose()?,
        })),
    }
}

/// The `size×size` matrix of an array, checked to be symmetric (`sign` 1) or skew (`sign` -1) and made exactly so.
fn mirrored(file: &str, name: &str, size: usize, array: &Array, sign: f64) -> Result<Mat<f64>, RigError> {
    let at = |row: usize, column: usize| array.values[row * size + column];
    let limit = SYMMETRY * array.values.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    let kind = if sign > 0.0 { "symmetric" } else { "skew-symmetric" };
    for row in 0..size {
        if let Some(column) = (0..=row).find(|&column| (at(row, column) - sign * at(column, row)).abs() > limit) {
            let value = format!("is {}, its mirror image {}", at(row, column), at(column, row));
            let limit = format!("a difference of at most {limit:.3e}: a {kind} matrix");
            return Err(refuse(file, &format!("{name}[{row}, {column}]"), &value, &limit));
        }
    }
    Ok(Mat::from_fn(size, size, |row, column| 0.5 * (at(row, column) + sign * at(column, row))))
}

fn refuse(file: &str, field: &str, value: &str, limit: &str) -> RigError {
    RigError::Npz { file: file.to_owned(), field: field.to_owned(), value: value.to_owned(), limit: limit.to_owned() }
}

fn dimensions(shape: &[usize]) -> String {
    shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
}

/// An open archive, with the size of the arrays read so far.
struct Archive<'a> {
    file: &'a str,
    zip: npyz::npz::NpzArchive<Cursor<&'a [u8]>>,
    /// Bytes taken by the arrays read so far, and the largest total allowed.
    unpacked: u64,
    limit: u64,
}

impl<'a> Archive<'a> {
    fn open(file: &'a str, bytes: &'a [u8]) -> Result<Self, RigError> {
        let zip = npyz::npz::NpzArchive::new(Cursor::new(bytes)).map_err(|error| {
            let limit = "an .npz archive as numpy.savez writes it";
            refuse(file, "(archive)", &format!("cannot be opened: {error}"), limit)
        })?;
        let (times, at_least) = MOST_TIMES_ARCHIVE;
        let limit = (times * bytes.len() as u64).clamp(at_least, MOST_BYTES);
        Ok(Self { file, zip, unpacked: 0, limit })
    }

    /// The array called `name`; `None` if it is absent. `fits` checks the shape and returns the expected one if it
    /// differs.
    fn array(
        &mut self,
        name: &str,
        fits: impl FnOnce(&[usize]) -> Result<(), String>,
    ) -> Result<Option<Array>, RigError> {
        let file = self.file;
        let readable = "an array of numbers as numpy writes it";
        let unreadable =
            |error: &dyn std::fmt::Display| refuse(file, name, &format!("cannot be read: {error}"), readable);
        let entry_name = npyz::npz::file_name_from_array_name(name);
        let zip = self.zip.zip_archive();
        if !zip.file_names().any(|entry| entry == entry_name) {
            return Ok(None);
        }
        let mut entry = zip.by_name(&entry_name).map_err(|error| unreadable(&error))?;
        let there = entry.size();
        let mut head = vec![];
        entry.by_ref().take(LONGEST_HEADER as u64).read_to_end(&mut head).map_err(|error| unreadable(&error))?;
        let header = check_header(&head).map_err(|reason| unreadable(&reason))?;
        let array = NpyFile::new(head.as_slice()).map_err(|error| unreadable(&error))?;
        let length = |length: &u64| usize::try_from(*length).unwrap_or(usize::MAX);
        let shape: Vec<usize> = array.shape().iter().map(length).collect();
        let refuse_shape = |value: &str, limit: &str| {
            Err(refuse(file, name, &format!("has shape ({}){value}", dimensions(&shape)), limit))
        };
        let scalar = match array.dtype() {
            DType::Plain(scalar) => scalar,
            other => {
                let value = format!("has type {}", other.descr());
                return Err(refuse(file, name, &value, "float64, float32 or an integer"));
            }
        };
        if let Err(limit) = fits(&shape) {
            return refuse_shape("", &limit);
        }
        let count = shape.iter().try_fold(1_usize, |product, &length| product.checked_mul(length));
        let size = scalar.size_field() as usize;
        let needed = |each: usize| Some(count?.checked_mul(each)? as u64);
        // Header and archive entry are untrusted: both must agree that all values are present.
        let Some(count) = count.filter(|_| needed(size).is_some_and(|bytes| header as u64 + bytes <= there)) else {
            return refuse_shape(&format!(" but {there} bytes"), "all its values");
        };
        self.unpacked = needed(size_of::<f64>()).map_or(u64::MAX, |bytes| self.unpacked.saturating_add(bytes));
        if self.unpacked > self.limit {
            let limit = format!("at most {} bytes in the arrays of this archive, by its size", self.limit);
            return refuse_shape(&format!(", with which the archive unpacks to {} bytes", self.unpacked), &limit);
        }
        let fortran = array.order() == Order::Fortran;
        let rest = BufReader::new(head[header..].chain(entry));
        let data = NpyFile::with_header(array.header().clone(), rest);
        let values = match (scalar.type_char(), size) {
            (TypeChar::Float, 8) => values::<f64>(data, count, |value| value),
            (TypeChar::Float, 4) => values::<f32>(data, count, f64::from),
            (TypeChar::Int, 8) => values::<i64>(data, count, |value| value as f64),
            (TypeChar::Int, 4) => values::<i32>(data, count, f64::from),
            _ => return Err(refuse(file, name, &format!("has type {scalar}"), "float64, float32, int64 or int32")),
        };
        let mut values = values.map_err(|error| unreadable(&error))?;
        if fortran {
            values = to_c_order(&shape, &values);
        }
        if let Some((index, &value)) = values.iter().enumerate().find(|(_, value)| !value.is_finite()) {
            let field = format!("{name}[{}]", dimensions(&position(&shape, index)));
            return Err(RigError::NotFinite { file: file.to_owned(), field, value });
        }
        Ok(Some(Array { shape, values }))
    }
}

/// Reads the `count` values of an array.
fn values<T: Deserialize>(data: NpyFile<impl Read>, count: usize, to: fn(T) -> f64) -> io::Result<Vec<f64>> {
    let mut values = Vec::with_capacity(count);
    for value in data.data::<T>().map_err(io::Error::other)? {
        values.push(to(value?));
    }
    Ok(values)
}

/// Length of an array's header, bytes. Refuses headers on which the npy reader would overflow: too long, or with
/// numbers whose product is not a plausible size.
fn check_header(bytes: &[u8]) -> Result<usize, String> {
    let length = match bytes.get(..12) {
        Some([0x93, b'N', b'U', b'M', b'P', b'Y', 1, _, low, high, ..]) => {
            10 + usize::from(u16::from_le_bytes([*low, *high]))
        }
        Some(&[0x93, b'N', b'U', b'M', b'P', b'Y', 2 | 3, _, a, b, c, d]) => {
            12_usize.saturating_add(u32::from_le_bytes([a, b, c, d]) as usize)
        }
        _ => return Err("it does not start as an array".to_owned()),
    };
    if length > LONGEST_HEADER || length > bytes.len() {
        return Err(format!("its header of {length} bytes is longer than {LONGEST_HEADER} or than the file"));
    }
    let mut product = 1_u64;
    for digits in bytes[8..length].split(|byte| !byte.is_ascii_digit()).filter(|digits| !digits.is_empty()) {
        let number = std::str::from_utf8(digits).ok().and_then(|digits| digits.parse::<u64>().ok());
        product = number
            .and_then(|number| product.checked_mul(number.max(1)))
            .filter(|product| *product < 1 << 50)
            .ok_or("the numbers in its header are too large")?;
    }
    Ok(length)
}

/// Index along each axis of the `flat`-th value in C order.
fn position(shape: &[usize], flat: usize) -> Vec<usize> {
    let mut rest = flat;
    let mut indices: Vec<usize> = shape
        .iter()
        .rev()
        .map(|&length| {
            let index = rest % length.max(1);
            rest /= length.max(1);
            index
        })
        .collect();
    indices.reverse();
    indices
}

/// Converts values from Fortran order (the first axis varies fastest) to C order.
fn to_c_order(shape: &[usize], values: &[f64]) -> Vec<f64> {
    let strides: Vec<usize> = shape
        .iter()
        .scan(1, |next, &length| {
            let stride = *next;
            *next *= length;
            Some(stride)
        })
        .collect();
    let (mut index, mut from) = (vec![0; shape.len()], 0);
    let mut ordered = Vec::with_capacity(values.len());
    for _ in values {
        ordered.push(values[from]);
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            from += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            from -= strides[axis] * shape[axis];
            index[axis] = 0;
        }
    }
    ordered
}
