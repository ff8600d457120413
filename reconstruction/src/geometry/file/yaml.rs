//! The YAML that OpenCV's FileStorage, ROS and their like write calibrations in: one mapping of scalars, of lists of
//! numbers, and of matrices as `rows`, `cols`, `data`. OpenCV's own header (`%YAML:1.0`) is not YAML, which is why
//! general parsers refuse these files.

use super::value::{Array, MAX_ELEMENTS, Node, Nodes};

const MAX_LINES: usize = 200_000;
/// Lists in lists; a matrix has two levels.
const MAX_DEPTH: usize = 4;

/// A key with everything that belongs to it.
struct Entry<'a> {
    key: &'a str,
    /// Text after the colon, without a tag.
    inline: &'a str,
    /// Lines below it.
    block: &'a [&'a str],
}

/// Reads the top-level mapping.
pub(super) fn read(text: &str) -> Result<Nodes, String> {
    let lines: Vec<&str> = text.trim_start_matches('\u{feff}').lines().take(MAX_LINES + 1).collect();
    if lines.len() > MAX_LINES {
        return Err(format!("it has more than {MAX_LINES} lines"));
    }
    let mut nodes = Nodes::new();
    for entry in entries(&lines, 0)? {
        if let Some(node) = value(&entry, true).map_err(|fault| format!("{} {fault}", entry.key))?
            && nodes.insert(entry.key.to_owned(), node).is_some()
        {
            return Err(format!("{} occurs twice", entry.key));
        }
    }
    Ok(nodes)
}

fn is_noise(line: &str) -> bool {
    let text = line.trim();
    text.is_empty() || text.starts_with(['#', '%']) || text.starts_with("---") || text == "..."
}

fn indentation(line: &str) -> usize {
    line.len() - line.trim_start_matches(' ').len()
}

/// Splits lines of a mapping at `indent` into its entries.
fn entries<'a>(lines: &'a [&'a str], indent: usize) -> Result<Vec<Entry<'a>>, String> {
    let mut entries = Vec::new();
    let mut at = 0;
    while at < lines.len() {
        let line = lines[at];
        at += 1;
        if is_noise(line) {
            continue;
        }
        let Some((key, rest)) = line.split_once(':').filter(|_| indentation(line) == indent) else {
            return Err(format!("has a line that is no `key: value`: {:?}", shorten(line)));
        };
        let start = at;
        // A list may also stand at the indentation of its key.
        while at < lines.len()
            && (is_noise(lines[at])
                || indentation(lines[at]) > indent
                || lines[at].trim_start().starts_with("- ")
                || lines[at].trim_start().starts_with(']'))
        {
            at += 1;
        }
        let mut inline = strip_comment(rest).trim();
        if inline.starts_with('!') {
            inline = inline.split_once(char::is_whitespace).map_or("", |(_, rest)| rest.trim());
        }
        let key = key.trim().trim_matches(['"', '\'']);
        entries.push(Entry { key, inline, block: &lines[start..at] });
    }
    Ok(entries)
}

fn strip_comment(line: &str) -> &str {
    line.find(" #").map_or(line, |at| &line[..at])
}

fn shorten(line: &str) -> String {
    line.trim().chars().take(40).collect()
}

/// Value of an entry; `nested` allows it to be a matrix, which bounds the recursion.
fn value(entry: &Entry<'_>, nested: bool) -> Result<Option<Node>, String> {
    if entry.inline.starts_with('[') {
        let mut text = entry.inline.to_owned();
        for line in entry.block {
            text.push(' ');
            text.push_str(strip_comment(line));
        }
        return Ok(flow(&text)?.map(Node::Array));
    }
    if !entry.inline.is_empty() {
        let text = entry.inline.trim_matches(['"', '\'']);
        return Ok(Some(match number(text) {
            Some(value) => Node::Array(Array::scalar(value)),
            None => Node::Text(text.to_owned()),
        }));
    }
    let Some(first) = entry.block.iter().find(|line| !is_noise(line)) else {
        return Ok(None);
    };
    if first.trim_start().starts_with('-') && first.trim_start()[1..].starts_with(' ') {
        return block_list(entry.block);
    }
    if nested { matrix(entry.block, indentation(first)) } else { Ok(None) }
}

/// `- 1` or `- [1, 2]` per line; `None` for lists of other things.
fn block_list(block: &[&str]) -> Result<Option<Node>, String> {
    let mut text = String::from("[");
    for line in block.iter().filter(|line| !is_noise(line)) {
        let line = strip_comment(line).trim();
        let item = line.strip_prefix("- ").map(str::trim);
        if text.len() > 1 && item.is_some() {
            text.push(',');
        }
        text.push_str(item.unwrap_or(line));
        text.push(' ');
    }
    text.push(']');
    Ok(flow(&text).unwrap_or_default().map(Node::Array))
}

/// A mapping with rows, cols and data; `None` for any other mapping.
fn matrix(block: &[&str], indent: usize) -> Result<Option<Node>, String> {
    let entries = entries(block, indent)?;
    let find = |key: &str| entries.iter().find(|e| e.key == key);
    let (Some(rows), Some(columns), Some(data)) = (find("rows"), find("cols"), find("data")) else {
        return Ok(None);
    };
    let (Ok(rows), Ok(columns)) = (rows.inline.parse::<usize>(), columns.inline.parse::<usize>()) else {
        return Err("has rows or cols that are not whole numbers".to_owned());
    };
    if rows.checked_mul(columns).is_none_or(|n| n > MAX_ELEMENTS) {
        return Ok(None);
    }
    match value(data, false)? {
        Some(Node::Array(array)) if array.data.len() == rows * columns => {
            Ok(Some(Node::Array(Array { rows, columns, data: array.data })))
        }
        _ => Err(format!("says {rows}x{columns}, but its data is not that many numbers")),
    }
}

/// `[1, 2, [3, 4]]` of numbers; `None` if it holds anything else or is large. Rows are those of the outer list.
fn flow(text: &str) -> Result<Option<Array>, String> {
    let (mut depth, mut outer, mut nested, mut done) = (0_usize, 0_usize, false, false);
    let mut data = Vec::new();
    let mut token = String::new();
    for c in text.chars() {
        if done {
            if !c.is_whitespace() {
                return Err("has text after its list".to_owned());
            }
            continue;
        }
        if matches!(c, '[' | ']' | ',') && !token.trim().is_empty() {
            let Some(value) = number(token.trim()) else {
                return Ok(None);
            };
            data.push(value);
            outer += usize::from(depth == 1);
        }
        match c {
            '[' => {
                depth += 1;
                nested |= depth == 2;
                outer += usize::from(depth == 2);
            }
            ']' => {
                depth = depth.saturating_sub(1);
                done = depth == 0;
            }
            ',' => {}
            c => {
                token.push(c);
                continue;
            }
        }
        token.clear();
        if depth > MAX_DEPTH || data.len() > MAX_ELEMENTS {
            return Ok(None);
        }
    }
    if !done {
        return Err("has a list that does not end".to_owned());
    }
    if nested && (outer == 0 || data.len() % outer != 0) {
        return Ok(None);
    }
    let columns = if nested { data.len() / outer } else { 1 };
    Ok(Some(Array { rows: if nested { outer } else { data.len() }, columns, data }))
}

/// A number of YAML or of OpenCV (`1.`, `.Nan`, `-.Inf`).
pub(super) fn number(text: &str) -> Option<f64> {
    match text.trim().to_ascii_lowercase().as_str() {
        ".nan" => Some(f64::NAN),
        ".inf" | "+.inf" => Some(f64::INFINITY),
        "-.inf" => Some(f64::NEG_INFINITY),
        text => text.parse().ok(),
    }
}
