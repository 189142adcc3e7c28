//! Modes of a substructure as a finite-element program wrote them: an `.npz` archive of numpy arrays.

use std::io::{Cursor, Read};

use faer::Mat;
use npyz::{NpyFile, Order, TypeChar};

use super::RigError;
use super::modal_data::{ModalData, Residual};
use crate::physics::ResidualFlexibility;

/// Largest array that is read, in bytes: a limit for archives that unpack to far more than they hold.
const LARGEST: u64 = 2 << 30;
/// Longest header of an array, in bytes; numpy writes 128.
const LONGEST_HEADER: usize = 1024;
/// Two mirrored entries of a residual may differ by this times its largest entry: what printing with ten digits leaves.
const SYMMETRY: f64 = 1e-9;

/// A numpy array, rewritten to C order.
struct Array {
    shape: Vec<usize>,
    values: Vec<f64>,
}

/// Reads what the modes left out do between `c` contact pairs: `flexibility_sliding` and `inertia_sliding` (c, c),
/// `flexibility_normal` and `inertia_normal` (c (c + 1) / 2), the lower triangles of symmetric matrices row by row. Without
/// inertia both of its arrays are missing.
///
/// # Errors
/// [`RigError::Npz`], [`RigError::NotFinite`].
pub fn read_pair_residual(file: &str, bytes: &[u8], c: usize) -> Result<ResidualFlexibility, RigError> {
    let mut archive = open(file, bytes)?;
    let triangle = |row: usize, column: usize| row * (row + 1) / 2 + column;
    let mut both = |kind: &str| -> Result<Option<[Mat<f64>; 2]>, RigError> {
        let names = ["normal", "sliding"].map(|direction| format!("{kind}_{direction}"));
        let shapes = [vec![triangle(c, 0)], vec![c, c]];
        let mut arrays = vec![];
        for (name, shape) in names.iter().zip(&shapes) {
            let array = read_array(file, &mut archive, name)?;
            if let Some(array) = array.as_ref().filter(|array| array.shape != *shape) {
                let (value, limit) = (format!("has shape ({})", told(&array.shape)), format!("({})", told(shape)));
                return Err(refuse(file, name, &value, &format!("{limit}, by the {c} contact pairs")));
            }
            arrays.push(array);
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

/// Reads `omega_rad_s` (i), `phi` (c, 3, i), `nodes_m` (c, 3) and, where they are there, `damping_ratio` (i), `mass_share`
/// (i, i), `residual_flexibility` and `residual_inertia` (3c, 3c).
///
/// # Errors
/// [`RigError::Npz`], [`RigError::NotFinite`].
pub fn read(file: &str, bytes: &[u8]) -> Result<ModalData, RigError> {
    let mut archive = open(file, bytes)?;
    let mut array = |name: &str| read_array(file, &mut archive, name);
    let required = |name: &str, array: Option<Array>, shape: &str| {
        array.ok_or_else(|| refuse(file, name, "is missing", &format!("an array of shape {shape}")))
    };
    let omega = required("omega_rad_s", array("omega_rad_s")?, "(i)")?;
    let phi = required("phi", array("phi")?, "(c, 3, i)")?;
    let nodes = required("nodes_m", array("nodes_m")?, "(c, 3)")?;
    let damping = array("damping_ratio")?;
    let mass_share = array("mass_share")?;
    let residuals = [array("residual_flexibility")?, array("residual_inertia")?];

    let wrong = |name: &str, array: &Array, limit: &str| {
        Err(refuse(file, name, &format!("has shape ({})", told(&array.shape)), limit))
    };
    let &[modes] = omega.shape.as_slice() else { return wrong("omega_rad_s", &omega, "(i)") };
    let &[count, 3] = nodes.shape.as_slice() else { return wrong("nodes_m", &nodes, "(c, 3)") };
    if modes == 0 || count == 0 {
        return wrong("phi", &phi, "at least one node and one mode");
    }
    if phi.shape != [count, 3, modes] {
        return wrong("phi", &phi, &format!("({count}, 3, {modes}), by nodes_m and omega_rad_s"));
    }
    if let Some(damping) = &damping
        && damping.shape != [modes]
    {
        return wrong("damping_ratio", damping, &format!("({modes}), as omega_rad_s"));
    }
    if let Some((mode, value)) = omega.values.iter().enumerate().find(|(_, value)| **value < 0.0) {
        return Err(refuse(file, &format!("omega_rad_s[{mode}]"), &format!("is {value}"), "at least 0"));
    }
    let mass_share = match mass_share {
        Some(share) if share.shape != [modes, modes] => {
            return wrong("mass_share", &share, &format!("({modes}, {modes}), by omega_rad_s"));
        }
        share => share.map(|share| Mat::from_fn(modes, modes, |i, j| share.values[i * modes + j])),
    };
    let residual = residual(file, count, residuals)?;
    let nodes_m = nodes.values.chunks_exact(3).map(|node| [node[0], node[1], node[2]]).collect();
    Ok(ModalData {
        omega_rad_s: omega.values,
        phi: phi.values,
        nodes_m,
        damping_ratio: damping.map(|damping| damping.values),
        mass_share,
        residual,
    })
}

/// Residual flexibility and inertia between the three directions of every one of `count` nodes.
fn residual(file: &str, count: usize, arrays: [Option<Array>; 2]) -> Result<Option<Residual>, RigError> {
    let names = ["residual_flexibility", "residual_inertia"];
    let symmetric = |name: &str, array: Array| -> Result<Mat<f64>, RigError> {
        let size = 3 * count;
        if array.shape != [size, size] {
            let limit = format!("({size}, {size}), by nodes_m");
            return Err(refuse(file, name, &format!("has shape ({})", told(&array.shape)), &limit));
        }
        let at = |row: usize, column: usize| array.values[row * size + column];
        let limit = SYMMETRY * array.values.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
        for row in 0..size {
            if at(row, row) < 0.0 {
                let value = format!("is {}", at(row, row));
                return Err(refuse(file, &format!("{name}[{row}, {row}]"), &value, "at least 0"));
            }
            if let Some(column) = (0..row).find(|&column| (at(row, column) - at(column, row)).abs() > limit) {
                let value = format!("is {}, its mirror image {}", at(row, column), at(column, row));
                let limit = format!("a difference of at most {limit:.3e}: a symmetric matrix");
                return Err(refuse(file, &format!("{name}[{row}, {column}]"), &value, &limit));
            }
        }
        Ok(Mat::from_fn(size, size, |row, column| 0.5 * (at(row, column) + at(column, row))))
    };
    match arrays {
        [None, None] => Ok(None),
        [None, Some(_)] => Err(refuse(file, names[1], "stands without residual_flexibility", "both, or neither")),
        [Some(flexibility), inertia] => Ok(Some(Residual {
            flexibility: symmetric(names[0], flexibility)?,
            inertia: inertia.map(|inertia| symmetric(names[1], inertia)).transpose()?,
        })),
    }
}

fn open<'a>(file: &str, bytes: &'a [u8]) -> Result<npyz::npz::NpzArchive<Cursor<&'a [u8]>>, RigError> {
    npyz::npz::NpzArchive::new(Cursor::new(bytes)).map_err(|error| {
        let limit = "an .npz archive as numpy.savez writes it";
        refuse(file, "(archive)", &format!("cannot be opened: {error}"), limit)
    })
}

fn refuse(file: &str, field: &str, value: &str, limit: &str) -> RigError {
    RigError::Npz { file: file.to_owned(), field: field.to_owned(), value: value.to_owned(), limit: limit.to_owned() }
}

fn told(shape: &[usize]) -> String {
    shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
}

/// An array of the archive by name; `None` where it is not there.
fn read_array(
    file: &str,
    archive: &mut npyz::npz::NpzArchive<Cursor<&[u8]>>,
    name: &str,
) -> Result<Option<Array>, RigError> {
    let readable = "an array of numbers as numpy writes it";
    let unreadable = |error: &dyn std::fmt::Display| refuse(file, name, &format!("cannot be read: {error}"), readable);
    let entry_name = npyz::npz::file_name_from_array_name(name);
    let zip = archive.zip_archive();
    if !zip.file_names().any(|entry| entry == entry_name) {
        return Ok(None);
    }
    let entry = zip.by_name(&entry_name).map_err(|error| unreadable(&error))?;
    let mut bytes = vec![];
    entry.take(LARGEST + 1).read_to_end(&mut bytes).map_err(|error| unreadable(&error))?;
    if bytes.len() as u64 > LARGEST {
        return Err(refuse(file, name, &format!("is larger than {LARGEST} bytes"), "a smaller array"));
    }
    check_header(&bytes).map_err(|reason| unreadable(&reason))?;
    let array = NpyFile::new(bytes.as_slice()).map_err(|error| unreadable(&error))?;
    let shape: Vec<usize> = array.shape().iter().map(|&length| usize::try_from(length).unwrap_or(usize::MAX)).collect();
    let fortran = array.order() == Order::Fortran;
    let scalar = match array.dtype() {
        npyz::DType::Plain(scalar) => scalar,
        other => {
            return Err(refuse(file, name, &format!("has type {}", other.descr()), "float64, float32 or an integer"));
        }
    };
    let length = shape.iter().try_fold(1_usize, |product, &length| product.checked_mul(length));
    let size = scalar.size_field() as usize;
    // The values must be there before memory is asked for them.
    if length.and_then(|length| length.checked_mul(size)).is_none_or(|needed| needed > bytes.len()) {
        return Err(refuse(
            file,
            name,
            &format!("has shape ({}) but {} bytes", told(&shape), bytes.len()),
            "all its values",
        ));
    }
    let values: std::io::Result<Vec<f64>> = match (scalar.type_char(), size) {
        (TypeChar::Float, 8) => array.into_vec::<f64>(),
        (TypeChar::Float, 4) => array.into_vec::<f32>().map(|values| values.into_iter().map(f64::from).collect()),
        (TypeChar::Int, 8) => array.into_vec::<i64>().map(|values| values.into_iter().map(|v| v as f64).collect()),
        (TypeChar::Int, 4) => array.into_vec::<i32>().map(|values| values.into_iter().map(f64::from).collect()),
        _ => return Err(refuse(file, name, &format!("has type {scalar}"), "float64, float32, int64 or int32")),
    };
    let mut values = values.map_err(|error| unreadable(&error))?;
    if fortran {
        values = to_c_order(&shape, &values);
    }
    if let Some((index, &value)) = values.iter().enumerate().find(|(_, value)| !value.is_finite()) {
        let field = format!("{name}[{}]", told(&position(&shape, index)));
        return Err(RigError::NotFinite { file: file.to_owned(), field, value });
    }
    Ok(Some(Array { shape, values }))
}

/// Refuses headers on which the reader would overflow: too long, or with numbers whose product is no size.
fn check_header(bytes: &[u8]) -> Result<(), String> {
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
    Ok(())
}

/// Index of every axis of the `flat`-th value in C order.
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

fn to_c_order(shape: &[usize], values: &[f64]) -> Vec<f64> {
    (0..values.len())
        .map(|flat| {
            let (mut from, mut stride) = (0, 1);
            for (index, length) in position(shape, flat).iter().zip(shape) {
                from += index * stride;
                stride *= length;
            }
            values[from]
        })
        .collect()
}
