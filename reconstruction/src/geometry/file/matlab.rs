//! The part of MATLAB's language that the toolbox writes its results in: assignments of numbers and of matrices of
//! numbers. Everything else is passed over.

use super::value::{Array, MAX_ELEMENTS, MAX_VARIABLES, Node, Nodes};

/// Reads all assignments of numbers.
pub(super) fn read(text: &str) -> Result<Nodes, String> {
    let mut nodes = Nodes::new();
    for statement in statements(text) {
        if let Some((name, value)) = statement.split_once('=')
            && let name = name.trim()
            && is_name(name)
            && let Some(array) = parse(value.trim())
        {
            nodes.insert(name.to_owned(), Node::Array(array));
            if nodes.len() > MAX_VARIABLES {
                return Err(format!("it holds more than {MAX_VARIABLES} variables"));
            }
        }
    }
    if nodes.is_empty() {
        return Err("it holds no assignment of a number: it is no result of Bouguet's toolbox".to_owned());
    }
    Ok(nodes)
}

/// Splits at line ends and semicolons outside brackets; comments are dropped.
fn statements(text: &str) -> Vec<String> {
    let mut statements = vec![String::new()];
    let mut depth = 0_usize;
    for line in text.lines() {
        let code = line.split('%').next().unwrap_or_default();
        for c in code.chars() {
            match c {
                '[' => depth += 1,
                ']' => depth = depth.saturating_sub(1),
                _ => {}
            }
            if c == ';' && depth == 0 {
                statements.push(String::new());
            } else if let Some(last) = statements.last_mut() {
                last.push(c);
            }
        }
        if depth == 0 {
            statements.push(String::new());
        } else if let Some(last) = statements.last_mut() {
            // A line end inside brackets ends a row.
            last.push(';');
        }
    }
    statements
}

fn is_name(text: &str) -> bool {
    text.len() <= 63
        && text.starts_with(|c: char| c.is_ascii_alphabetic())
        && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

fn parse(value: &str) -> Option<Array> {
    let Some(body) = value.strip_prefix('[') else {
        return value.parse().ok().map(Array::scalar);
    };
    let body = body.strip_suffix(']')?;
    let mut data = Vec::new();
    let (mut rows, mut columns) = (0, 0);
    for row in body.split(';') {
        let before = data.len();
        for item in row.split([' ', '\t', ',']).filter(|item| !item.is_empty() && *item != "...") {
            if data.len() == MAX_ELEMENTS {
                return None;
            }
            data.push(item.parse().ok()?);
        }
        let width = data.len() - before;
        if width == 0 {
            continue;
        }
        if rows > 0 && width != columns {
            return None;
        }
        (rows, columns) = (rows + 1, width);
    }
    Some(Array { rows, columns, data })
}
