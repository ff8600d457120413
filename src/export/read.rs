//! A scan from its bundle.

use std::path::Path;

use sha2::{Digest as _, Sha256};

use super::{Organised, Origin, Scan};
use crate::{
    engine::Failure,
    store::{
        Manifest, Policy,
        manifest::FILE_NAME,
        measured::{self, CLOUD_FILE_NAME},
        source::{MAX_MANIFEST_BYTES, hex, read_bounded},
    },
};

impl Scan {
    /// Reads what `bundle`, a folder, holds of a scan.
    pub fn read(bundle: &Path) -> Result<Self, Failure> {
        let failed = |error: Box<dyn std::error::Error + Send + Sync>| {
            Failure::data(format!("read the scan {}", bundle.display()), error)
        };
        let origin = origin(bundle).map_err(failed)?;
        let maps = measured::read_maps(bundle).map_err(|error| failed(error.into()))?;
        let cloud = match measured::read_points(bundle).map_err(|error| failed(error.into()))? {
            None => None,
            Some(points) => {
                let pose = measured::read_world_from_camera(bundle).map_err(|error| failed(error.into()))?;
                let cloud = Organised::new(&maps.mask, points, pose).map_err(|detail| {
                    failed(format!("{}: {detail}", bundle.join(CLOUD_FILE_NAME).display()).into())
                })?;
                Some(cloud)
            }
        };
        Ok(Self { origin, maps, cloud })
    }
}

fn origin(bundle: &Path) -> Result<Origin, Box<dyn std::error::Error + Send + Sync>> {
    let path = bundle.join(FILE_NAME);
    let bytes = read_bounded(&path, Policy::Local, "read the manifest", MAX_MANIFEST_BYTES)?;
    let manifest = Manifest::parse(&bytes)
        .map_err(|faults| crate::store::InputError::Manifest { path, faults })?
        .manifest;
    let camera = manifest.rig.map(|rig| rig.camera);
    Ok(Origin {
        id: manifest.id.unwrap_or_else(|| hex(&Sha256::digest(&bytes))),
        label: manifest.label,
        created: manifest.created,
        software: manifest.software,
        camera_model: camera.as_ref().map(|camera| camera.model.clone()),
        camera_serial: camera.map(|camera| camera.serial),
    })
}
