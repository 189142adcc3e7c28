//! Scales of matrices: arithmetic expressions in the operating point.
//!
//! An expression consists of `+ - * / ^ ( )`, numbers and the names `normal_load_n`, `disc_speed_rad_s` and
//! `friction_coefficient`. It is tokenised here, so that no other feature of the expression crate is reachable, and
//! evaluated by `exmex`. `-a^b` and `a^b^c`, which programs read in different ways, are refused.

use std::sync::Arc;

use exmex::prelude::*;
use exmex::{BinOp, MakeOperators, Operator, ops_factory};

use crate::physics::{CustomLaw, Law, OperatingPoint};

/// The names an expression may use, in alphabetical order.
pub const NAMES: [&str; 3] = ["disc_speed_rad_s", "friction_coefficient", "normal_load_n"];

/// Longest accepted text, bytes.
const LONGEST: usize = 1000;
/// Deepest accepted nesting of parentheses.
const DEEPEST: usize = 32;

/// A binary operator. Declared as not commutative, so that operators of equal precedence are applied from left to
/// right.
fn binary(apply: fn(f64, f64) -> f64, prio: i64) -> BinOp<f64> {
    BinOp { apply, prio, is_commutative: false }
}

ops_factory!(
    ScaleOperators,
    f64,
    Operator::make_bin("^", binary(f64::powf, 2)),
    Operator::make_bin("*", binary(|a, b| a * b, 1)),
    Operator::make_bin("/", binary(|a, b| a / b, 1)),
    Operator::make_bin_unary("+", binary(|a, b| a + b, 0), |a| a),
    Operator::make_bin_unary("-", binary(|a, b| a - b, 0), |a| -a)
);

/// Why a scale was refused: the offending part and what was expected.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScaleError {
    pub reason: String,
    pub limit: String,
}

fn refuse<T>(reason: impl Into<String>, limit: impl Into<String>) -> Result<T, ScaleError> {
    Err(ScaleError { reason: reason.into(), limit: limit.into() })
}

/// Parses a scale; `"1"` is [`Law::Constant`], anything else [`Law::Custom`].
///
/// # Errors
/// [`ScaleError`] for an unknown name, operator or function, an ambiguous power, or text that is not an expression.
pub fn parse(text: &str) -> Result<Law, ScaleError> {
    let tokens = tokenise(text)?;
    check_powers(&tokens)?;
    if tokens == [Token::Number(1.0)] {
        return Ok(Law::Constant);
    }
    let plain: Vec<String> = tokens.iter().map(Token::plain).collect();
    let expression = FlatEx::<f64, ScaleOperators>::parse(&plain.join(" ")).or_else(|error| {
        refuse(format!("not an expression ({})", error.msg()), "numbers, names, + - * / ^ and balanced parentheses")
    })?;
    let used: Vec<usize> =
        (0..NAMES.len()).filter(|&name| expression.var_names().iter().any(|used| used == NAMES[name])).collect();
    let depends = |name: usize| used.contains(&name);
    Ok(Law::Custom(CustomLaw {
        text: text.to_owned(),
        depends_on_speed: depends(0),
        depends_on_friction: depends(1),
        depends_on_load: depends(2),
        evaluate: Arc::new(move |p: &OperatingPoint| {
            let all = [p.disc_speed_rad_s, p.friction_coefficient, p.normal_load_n];
            let mut values = [0.0; 3];
            for (value, &name) in values.iter_mut().zip(&used) {
                *value = all[name];
            }
            expression.eval(&values[..used.len()]).unwrap_or(f64::NAN)
        }),
    }))
}

#[derive(Clone, Debug, PartialEq)]
enum Token {
    Number(f64),
    Name(&'static str),
    /// One of `+ - * / ^`.
    Operator(char),
    Open,
    Close,
}

impl Token {
    /// The token in the syntax of `exmex`, which has no exponents in numbers.
    fn plain(&self) -> String {
        match self {
            Self::Number(value) => format!("{value}"),
            Self::Name(name) => (*name).to_owned(),
            Self::Operator(sign) => sign.to_string(),
            Self::Open => "(".to_owned(),
            Self::Close => ")".to_owned(),
        }
    }

    fn ends_operand(&self) -> bool {
        matches!(self, Self::Number(_) | Self::Name(_) | Self::Close)
    }
}

fn tokenise(text: &str) -> Result<Vec<Token>, ScaleError> {
    if text.len() > LONGEST {
        return refuse(format!("{} bytes long", text.len()), format!("at most {LONGEST} bytes"));
    }
    let mut tokens: Vec<Token> = vec![];
    let (mut depth, mut deepest) = (0_usize, 0_usize);
    let mut rest = text.trim_start();
    while let Some(first) = rest.chars().next() {
        let after_operand = tokens.last().is_some_and(Token::ends_operand);
        let (token, length) = match first {
            '0'..='9' | '.' => number(rest)?,
            'a'..='z' | 'A'..='Z' | '_' => {
                let length = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(rest.len());
                match NAMES.iter().find(|name| **name == &rest[..length]) {
                    Some(name) => (Token::Name(name), length),
                    None => return refuse(format!("unknown name `{}`", &rest[..length]), NAMES.join(", ")),
                }
            }
            '+' | '-' | '*' | '/' | '^' => (Token::Operator(first), 1),
            '(' => (Token::Open, 1),
            ')' => (Token::Close, 1),
            other => return refuse(format!("unknown character `{other}`"), "numbers, names and + - * / ^ ( )"),
        };
        match &token {
            Token::Number(_) | Token::Name(_) | Token::Open if after_operand => {
                return refuse(format!("no operator before `{}`", &rest[..length]), "+ - * / ^ between operands");
            }
            Token::Operator(sign) if !after_operand => match (sign, tokens.last()) {
                ('+' | '-', None | Some(Token::Open | Token::Operator('*' | '/' | '^'))) => {}
                _ => return refuse(format!("no operand before `{sign}`"), "a number, a name or ( ) there"),
            },
            Token::Close if !after_operand || depth == 0 => {
                return refuse("a `)` out of place", "balanced parentheses around an expression");
            }
            _ => {}
        }
        match token {
            Token::Open => depth += 1,
            Token::Close => depth -= 1,
            _ => {}
        }
        deepest = deepest.max(depth);
        tokens.push(token);
        rest = rest[length..].trim_start();
    }
    if deepest > DEEPEST {
        return refuse(format!("{deepest} parentheses deep"), format!("at most {DEEPEST}"));
    }
    if depth != 0 || !tokens.last().is_some_and(Token::ends_operand) {
        return refuse("ends too early", "an operand after every operator and a `)` for every `(`");
    }
    Ok(tokens)
}

/// Parses digits with an optional decimal point and an optional exponent. Returns the token and its length in bytes.
fn number(text: &str) -> Result<(Token, usize), ScaleError> {
    let bytes = text.as_bytes();
    let digits = |from: usize| bytes.iter().skip(from).take_while(|byte| byte.is_ascii_digit()).count();
    let mut length = digits(0);
    if bytes.get(length) == Some(&b'.') {
        length += 1;
        length += digits(length);
    }
    if matches!(bytes.get(length), Some(b'e' | b'E')) {
        let signed = length + 1 + usize::from(matches!(bytes.get(length + 1), Some(b'+' | b'-')));
        if digits(signed) > 0 {
            length = signed + digits(signed);
        }
    }
    match text[..length].parse::<f64>() {
        Ok(value) if value.is_finite() => Ok((Token::Number(value), length)),
        _ => refuse(format!("`{}` is no finite number", &text[..length]), "a number such as 0.3 or 1e-3"),
    }
}

/// Refuses `-a^b` and `a^b^c`.
fn check_powers(tokens: &[Token]) -> Result<(), ScaleError> {
    for (at, token) in tokens.iter().enumerate() {
        if *token != Token::Operator('^') {
            continue;
        }
        let Some(start) = operand_before(tokens, at) else { continue };
        match start.checked_sub(1).and_then(|before| tokens.get(before)) {
            Some(Token::Operator('^')) => return refuse("`a^b^c` has two readings", "(a^b)^c or a^(b^c)"),
            Some(Token::Operator(sign @ ('+' | '-'))) => {
                let unary = start < 2 || !tokens.get(start - 2).is_some_and(Token::ends_operand);
                if unary {
                    return refuse(format!("`{sign}a^b` has two readings"), format!("{sign}(a^b) or ({sign}a)^b"));
                }
            }
            _ => {}
        }
    }
    Ok(())
}

/// Start of the operand that ends before position `at`.
fn operand_before(tokens: &[Token], at: usize) -> Option<usize> {
    let mut depth = 0_usize;
    for (position, token) in tokens.iter().enumerate().take(at).rev() {
        match token {
            Token::Close => depth += 1,
            Token::Open => depth = depth.checked_sub(1)?,
            _ => {}
        }
        if depth == 0 {
            return Some(position);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str, load: f64, speed: f64, mu: f64) -> f64 {
        let p = OperatingPoint { normal_load_n: load, disc_speed_rad_s: speed, friction_coefficient: mu };
        match parse(text).unwrap_or_else(|error| panic!("{text}: {error:?}")) {
            Law::Constant => 1.0,
            Law::Custom(law) => (law.evaluate)(&p),
            law => panic!("{law:?}"),
        }
    }

    #[test]
    fn arithmetic_as_written_on_paper() {
        for (text, expected) in [
            ("1", 1.0),
            ("2 - 3 - 4", -5.0),
            ("12 / 3 / 2", 2.0),
            ("12 / 3 * 2", 8.0),
            ("3 * 12 / 2 / 3 * 5", 30.0),
            ("2 - 3 + 4", 3.0),
            ("8 - 2 * 3 ^ 2", -10.0),
            ("-(3 ^ 2) + (-3) ^ 2", 0.0),
            ("2 ^ -1", 0.5),
            ("2 * -3 - -(4)", -2.0),
            ("1e-3 * 2.5E+2", 0.25),
            (".5 + 2.", 2.5),
            ("disc_speed_rad_s^2 - 1", 35.0),
            ("1/disc_speed_rad_s-1", 1.0 / 6.0 - 1.0),
            ("friction_coefficient / 0.3", 0.5 / 0.3),
            ("normal_load_n/(friction_coefficient*disc_speed_rad_s)", 100.0 / 3.0),
        ] {
            if text == "2 * -3 - -(4)" {
                assert!(parse(text).is_err(), "a sign after a minus is refused");
                continue;
            }
            assert!((value(text, 100.0, 6.0, 0.5) - expected).abs() < 1e-14, "{text}");
        }
    }

    #[test]
    fn dependence_is_known() {
        let Law::Custom(law) = parse("friction_coefficient * normal_load_n / 500").unwrap() else { panic!() };
        assert!(law.depends_on_friction && law.depends_on_load && !law.depends_on_speed);
        assert!(matches!(parse(" 1.0 ").unwrap(), Law::Constant));
    }

    #[test]
    fn everything_else_is_refused_with_a_reason() {
        for (text, reason) in [
            ("mu / 0.3", "unknown name `mu`"),
            ("sin(1)", "unknown name `sin`"),
            ("PI", "unknown name `PI`"),
            ("{disc_speed_rad_s}", "unknown character `{`"),
            ("-disc_speed_rad_s^2", "`-a^b` has two readings"),
            ("2^3^2", "`a^b^c` has two readings"),
            ("2 3", "no operator before `3`"),
            ("2(3)", "no operator before `(`"),
            ("(2", "ends too early"),
            ("2)", "a `)` out of place"),
            ("()", "a `)` out of place"),
            ("", "ends too early"),
            ("* 2", "no operand before `*`"),
            ("1e999", "`1e999` is no finite number"),
            (".", "`.` is no finite number"),
        ] {
            assert_eq!(parse(text).map(|_| ()).unwrap_err().reason, reason, "{text}");
        }
    }
}
