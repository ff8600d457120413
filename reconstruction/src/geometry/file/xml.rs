//! OpenCV FileStorage in XML.

use roxmltree::{Document, Node as Element, ParsingOptions};

use super::value::{Array, MAX_ELEMENTS, Node, Nodes};

/// A calibration has a few dozen nodes.
const MAX_NODES: u32 = 100_000;
const MAX_DEPTH: usize = 64;

/// Reads the top-level nodes.
pub(super) fn read(text: &str) -> Result<Nodes, String> {
    check_depth(text)?;
    let options = ParsingOptions { allow_dtd: false, nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text.trim_start_matches('\u{feff}').trim_start(), options)
        .map_err(|error| format!("it is not XML: {error}"))?;
    let root = document.root_element();
    if !root.has_tag_name("opencv_storage") {
        return Err(format!("its root is <{}>, expected <opencv_storage>", root.tag_name().name()));
    }
    let mut nodes = Nodes::new();
    for element in root.children().filter(Element::is_element) {
        let name = element.tag_name().name().to_owned();
        if let Some(node) = value(element).map_err(|fault| format!("{name} {fault}"))?
            && nodes.insert(name.clone(), node).is_some()
        {
            return Err(format!("{name} occurs twice"));
        }
    }
    Ok(nodes)
}

/// Bounds nesting before the parser sees the text, whose own stack is not ours to bound.
fn check_depth(text: &str) -> Result<(), String> {
    let bytes = text.as_bytes();
    let mut depth = 0_usize;
    for pair in bytes.windows(2) {
        match pair {
            [b'<', b'/'] => depth = depth.saturating_sub(1),
            [b'/', b'>'] => depth = depth.saturating_sub(1),
            [b'<', c] if c.is_ascii_alphabetic() || *c == b'_' => depth += 1,
            _ => {}
        }
        if depth > MAX_DEPTH {
            return Err(format!("its elements are nested more than {MAX_DEPTH} deep"));
        }
    }
    Ok(())
}

fn value(element: Element<'_, '_>) -> Result<Option<Node>, String> {
    let child = |name: &str| element.children().find(|c| c.has_tag_name(name));
    if let (Some(rows), Some(columns), Some(data)) = (child("rows"), child("cols"), child("data")) {
        let count = |e: Element<'_, '_>| e.text().and_then(|t| t.trim().parse::<usize>().ok());
        let (Some(rows), Some(columns)) = (count(rows), count(columns)) else {
            return Err("has rows or cols that are not whole numbers".to_owned());
        };
        if rows.checked_mul(columns).is_none_or(|n| n > MAX_ELEMENTS) {
            return Ok(None);
        }
        let numbers = numbers(data.text().unwrap_or_default())
            .filter(|numbers| numbers.len() == rows * columns)
            .ok_or_else(|| format!("says {rows}x{columns}, but its data is not that many numbers"))?;
        return Ok(Some(Node::Array(Array { rows, columns, data: numbers })));
    }
    if element.children().any(|c| c.is_element() && !c.has_tag_name("_")) {
        return Ok(None);
    }
    let texts = element.descendants().filter(Element::is_text).filter_map(|t| t.text());
    let text = texts.collect::<Vec<_>>().join(" ");
    if text.len() > MAX_ELEMENTS * 32 {
        return Ok(None);
    }
    Ok(Some(match numbers(&text) {
        Some(data) if !data.is_empty() => Node::Array(Array::column(data)),
        _ => Node::Text(text.trim().trim_matches('"').to_owned()),
    }))
}

/// Numbers separated by white space; `None` if anything else is among them.
fn numbers(text: &str) -> Option<Vec<f64>> {
    text.split_ascii_whitespace().map(super::yaml::number).collect()
}
