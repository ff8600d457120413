//! E57 (ASTM E2807): one scan, organised, in metres, with normals.
//!
//! Points are in the camera frame and the pose of the scan is where the camera stands in the world, which is how the standard
//! means it: programs that apply the pose show the world frame. There is no sigma: the standard and its extensions have no
//! attribute for it, and one of our own no program would show. Points are in the order of the cloud, so that the sigmas of
//! the other formats fit.

use std::io::{self, Cursor, Write};

use e57::{
    DateTime, E57Writer, Extension, Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform,
    Translation,
};
use sha2::{Digest as _, Sha256};

use super::cloud::{Organised, Origin, one_line};
use crate::store::time::parse_rfc3339_utc;

/// Prefix and address of the extension by which E57 files have normals.
const NORMALS: (&str, &str) = ("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt");

/// 1980-01-06, from which the format counts, in seconds after 1970.
const GPS_EPOCH_S: f64 = 315_964_800.0;

/// What GPS time is ahead of UTC since 2017, in seconds.
const LEAP_SECONDS: f64 = 18.0;

const MM_PER_M: f64 = 1000.0;

/// Writes the file. It is made in memory, because its parts begin with lengths that are known at their ends.
pub fn write(out: &mut dyn Write, cloud: &Organised, origin: &Origin) -> io::Result<()> {
    out.write_all(&encode(cloud, origin).map_err(io::Error::other)?)
}

fn encode(cloud: &Organised, origin: &Origin) -> e57::Result<Vec<u8>> {
    let mut file = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut file, &guid("file", origin))?;
    let created = created(origin);
    writer.set_creation(created.clone());
    writer.register_extension(Extension::new(NORMALS.0, NORMALS.1))?;
    let mut scan = writer.add_pointcloud(&guid("scan", origin), prototype(cloud))?;
    let text = |text: &Option<String>| text.as_deref().map(plain);
    scan.set_name(Some(plain(origin.label.as_deref().unwrap_or(&origin.id))));
    scan.set_description(Some(plain(&format!("polscan, scan {}", origin.id))));
    scan.set_sensor_model(text(&origin.camera_model));
    scan.set_sensor_serial(text(&origin.camera_serial));
    scan.set_sensor_sw_version(text(&origin.software));
    scan.set_acquisition_start(created);
    scan.set_transform(Some(pose(cloud)));
    for ((point, normal), (pixel, measured)) in cloud.in_camera().zip(cloud.pixels.iter().zip(&cloud.points))
    {
        let mut values: Vec<RecordValue> = Vec::with_capacity(9);
        values.extend(point.map(|mm| RecordValue::Single((mm / MM_PER_M) as f32)));
        values.push(RecordValue::Integer(i64::from(measured.intensity)));
        values.push(RecordValue::Integer((pixel / cloud.width) as i64));
        values.push(RecordValue::Integer((pixel % cloud.width) as i64));
        values.extend(normal.map(|part| RecordValue::Single(part as f32)));
        scan.add_point(values)?;
    }
    scan.finalize()?;
    writer.finalize()?;
    drop(writer);
    Ok(file.into_inner())
}

fn prototype(cloud: &Organised) -> Vec<Record> {
    let float = |name| Record { name, data_type: RecordDataType::Single { min: None, max: None } };
    let whole =
        |name, max: usize| Record { name, data_type: RecordDataType::Integer { min: 0, max: max as i64 } };
    let normal =
        |name: &str| float(RecordName::Unknown { namespace: NORMALS.0.to_owned(), name: name.to_owned() });
    vec![
        float(RecordName::CartesianX),
        float(RecordName::CartesianY),
        float(RecordName::CartesianZ),
        whole(RecordName::Intensity, 255),
        whole(RecordName::RowIndex, cloud.height.saturating_sub(1)),
        whole(RecordName::ColumnIndex, cloud.width.saturating_sub(1)),
        normal("normalX"),
        normal("normalY"),
        normal("normalZ"),
    ]
}

fn pose(cloud: &Organised) -> Transform {
    let (position_mm, [w, x, y, z]) = cloud.viewpoint();
    let [along_x, along_y, along_z] = position_mm.map(|mm| mm / MM_PER_M);
    Transform {
        rotation: Quaternion { w, x, y, z },
        translation: Translation { x: along_x, y: along_y, z: along_z },
    }
}

fn created(origin: &Origin) -> Option<DateTime> {
    let since = parse_rfc3339_utc(origin.created.as_deref()?)?;
    let gps_time = since.as_secs_f64() - GPS_EPOCH_S + LEAP_SECONDS;
    Some(DateTime { gps_time, atomic_reference: false })
}

/// An identity that follows from that of the scan, so that equal scans give equal files.
fn guid(of: &str, origin: &Origin) -> String {
    let digest = Sha256::digest(format!("polscan e57 {of} {}", origin.id));
    let mut bytes = [0; 16];
    bytes.copy_from_slice(&digest[..16]);
    let uuid = uuid::Builder::from_bytes(bytes)
        .with_variant(uuid::Variant::RFC4122)
        .with_version(uuid::Version::Custom)
        .into_uuid();
    format!("{{{}}}", uuid.hyphenated())
}

/// Text that XML can hold where the library writes it: as it is, up to the mark that would end it.
fn plain(text: &str) -> String {
    one_line(text).replace("]]>", "]] >")
}
