//! `polscan patterns`: the pictures of a mode as PNG, with the manifest of a capture of them.

use std::{path::Path, str::FromStr};

use polscan_patterns::{Mode, ProjectorSize, Sequence};

use super::Failure;
use crate::config::Settings;

/// A projector size on the command line.
#[derive(Debug, Clone, Copy)]
pub struct Size(ProjectorSize);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (width, height) = text.split_once('x').ok_or("expected WIDTHxHEIGHT, such as 1024x768")?;
        let side = |text: &str| match text.parse::<u32>() {
            Ok(side @ 1..=8192) => Ok(side),
            _ => Err(format!("`{text}` is not a side of 1 to 8192 pixels")),
        };
        Ok(Self(ProjectorSize { width: side(width)?, height: side(height)? }))
    }
}
