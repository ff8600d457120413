//! Pictures of maps and clouds. Pure: grids in, images out.
//!
//! Maps keep their pixels one to one at the upper left and get a colour bar at their right; [`overview`] puts a whole
//! scan on one sheet, [`cloud_view`] shows the cloud obliquely.

mod canvas;
mod maps;
mod sheet;
mod text;
pub(crate) mod ticks;
mod view;

pub use maps::{
    MapStyle, Range, class_color, class_name, class_picture, column_picture, depth_picture, dolp_picture,
    frame_picture, intensity_picture, map_overlay, map_picture, residual_picture, row_picture,
};
pub use sheet::{OverviewInput, overview};
pub use view::{ViewSettings, cloud_view};
