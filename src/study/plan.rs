//! Which cases are computed together, and by which shard.

use std::ops::Range;
use std::str::FromStr;

/// The cases of a study in parts, each of which becomes a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    pub cases: u64,
    pub cases_per_file: u64,
}

/// A share of the parts: the `index`-th, from 1, of every `of` parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    pub index: u64,
    pub of: u64,
}

impl Shard {
    /// Everything.
    pub const WHOLE: Self = Self { index: 1, of: 1 };
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once('/').and_then(|(index, of)| Some((index.parse().ok()?, of.parse().ok()?)));
        match parsed {
            Some((index, of)) if (1..=of).contains(&index) => Ok(Self { index, of }),
            Some(_) | None => Err(format!("{text} is no shard, expected i/n with i from 1 to n")),
        }
    }
}

impl Plan {
    pub fn parts(&self) -> u64 {
        self.cases.div_ceil(self.cases_per_file)
    }

    /// The cases of a part.
    pub fn part(&self, part: u64) -> Range<u64> {
        let first = part * self.cases_per_file;
        first..(first + self.cases_per_file).min(self.cases)
    }

    /// The parts of a shard.
    pub fn of_shard(&self, shard: Shard) -> impl Iterator<Item = u64> {
        (shard.index - 1..self.parts()).step_by(usize::try_from(shard.of).unwrap_or(usize::MAX))
    }

    /// The name of the file of a part.
    pub fn file(&self, part: u64) -> String {
        let cases = self.part(part);
        let digits = self.cases.saturating_sub(1).to_string().len();
        format!("cases-{:0digits$}-{:0digits$}.parquet", cases.start, cases.end - 1)
    }

    /// The part whose file has this name.
    pub fn part_of(&self, name: &str) -> Option<u64> {
        let first: u64 = name.strip_prefix("cases-")?.split_once('-')?.0.parse().ok()?;
        let part = first / self.cases_per_file.max(1);
        (part < self.parts() && self.file(part) == name).then_some(part)
    }
}

/// Ranges of numbers in words: `0 to 99, 200 to 299`.
pub fn in_words(ranges: &[Range<u64>]) -> String {
    const SHOWN: usize = 5;
    let mut joined: Vec<Range<u64>> = vec![];
    for range in ranges {
        match joined.last_mut() {
            Some(last) if last.end == range.start => last.end = range.end,
            _ => joined.push(range.clone()),
        }
    }
    let word = |range: &Range<u64>| match range.end - range.start {
        1 => range.start.to_string(),
        _ => format!("{} to {}", range.start, range.end - 1),
    };
    let mut words: Vec<String> = joined.iter().take(SHOWN).map(word).collect();
    if joined.len() > SHOWN {
        words.push(format!("and {} more ranges", joined.len() - SHOWN));
    }
    words.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_case_is_in_one_part_and_every_part_in_one_shard() {
        for (cases, cases_per_file) in [(1, 1), (10, 3), (12, 4), (5, 100)] {
            let plan = Plan { cases, cases_per_file };
            let all: Vec<u64> = (0..plan.parts()).flat_map(|part| plan.part(part)).collect();
            assert_eq!(all, (0..cases).collect::<Vec<u64>>());
            for of in [1, 3, 8] {
                let mut parts: Vec<u64> = (1..=of).flat_map(|index| plan.of_shard(Shard { index, of })).collect();
                parts.sort_unstable();
                assert_eq!(parts, (0..plan.parts()).collect::<Vec<u64>>());
            }
            for part in 0..plan.parts() {
                assert_eq!(plan.part_of(&plan.file(part)), Some(part));
            }
        }
        let plan = Plan { cases: 10_000, cases_per_file: 100 };
        assert_eq!(plan.file(3), "cases-0300-0399.parquet");
        for name in ["cases-0300-0398.parquet", "cases-300-399.parquet", "table.parquet", "cases-9900-.parquet"] {
            assert_eq!(plan.part_of(name), None, "{name}");
        }
    }

    #[test]
    fn shards_are_counted_from_one() {
        assert_eq!("2/8".parse(), Ok(Shard { index: 2, of: 8 }));
        for text in ["0/3", "4/3", "1", "1/0", "a/b", "-1/2", "1/2/3"] {
            assert!(text.parse::<Shard>().is_err(), "{text}");
        }
    }

    #[test]
    fn ranges_are_joined_in_words() {
        assert_eq!(in_words(&[0..10, 10..20, 30..31]), "0 to 19, 30");
        let many: Vec<Range<u64>> = (0..9).map(|k| 2 * k..2 * k + 1).collect();
        assert_eq!(in_words(&many), "0, 2, 4, 6, 8, and 4 more ranges");
    }
}
