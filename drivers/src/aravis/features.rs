//! Access to a camera's features by name, with errors told apart: a feature that says no, or a camera that is gone.

use aravis::{
    Camera, Device, GcBoolean, GcFloat, GcInteger, GcNode,
    glib::{self, prelude::*},
    prelude::*,
};

use crate::error::DeviceError;

/// Why a feature was not read or written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Trouble {
    /// The feature is not there, is locked, or does not take the value; in words.
    Feature(String),
    /// The camera does not answer; in words.
    Camera(String),
}

impl Trouble {
    fn new(error: &glib::Error) -> Self {
        use aravis::DeviceError as Kind;
        let gone = [
            Kind::NotConnected,
            Kind::ProtocolError,
            Kind::TransferError,
            Kind::Timeout,
            Kind::NotFound,
            Kind::NotController,
        ];
        let message = error.message().to_owned();
        if gone.into_iter().any(|kind| error.matches(kind)) {
            Self::Camera(message)
        } else {
            Self::Feature(message)
        }
    }

    /// The words.
    pub fn message(&self) -> &str {
        match self {
            Self::Feature(message) | Self::Camera(message) => message,
        }
    }
}

/// The value of a feature.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// An entry of an enumeration.
    Entry(String),
    /// A switch.
    Switch(bool),
    /// A quantity.
    Number(f64),
}

/// The features of an open camera. Stays on the thread that owns the camera.
pub struct Features {
    camera: Camera,
    device: Device,
}

impl Features {
    /// Of `camera`; checks every value that is written against the range that the camera states.
    pub fn new(camera: Camera) -> Result<Self, DeviceError> {
        let device = camera.device().ok_or_else(|| DeviceError::Unavailable {
            device: "camera".to_owned(),
            detail: "the library opened it without a device; open it again".to_owned(),
        })?;
        camera.set_range_check_policy(aravis::RangeCheckPolicy::Enable);
        Ok(Self { camera, device })
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Its device.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Whether the camera has the feature and it can be used now.
    pub fn has(&self, name: &str) -> bool {
        self.device.is_feature_available(name).unwrap_or(false)
    }

    /// The first of `names` that the camera has.
    pub fn first<'n>(&self, names: &[&'n str]) -> Option<&'n str> {
        names.iter().copied().find(|name| self.has(name))
    }

    fn node(&self, name: &str) -> Option<GcNode> {
        self.device.feature(name)
    }

    /// Entries of an enumeration that can be chosen now.
    pub fn entries(&self, name: &str) -> Vec<String> {
        let entries = self.device.dup_available_enumeration_feature_values_as_strings(name);
        entries.unwrap_or_default().into_iter().map(|entry| entry.to_string()).collect()
    }

    /// Unit of a quantity, empty where the camera does not say.
    pub fn unit(&self, name: &str) -> String {
        let node = self.node(name);
        let unit = match node {
            Some(node) => match node.dynamic_cast::<GcFloat>() {
                Ok(float) => float.unit(),
                Err(node) => node.dynamic_cast::<GcInteger>().ok().and_then(|integer| integer.unit()),
            },
            None => None,
        };
        unit.map(|unit| unit.to_string()).unwrap_or_default()
    }

    /// Smallest and largest value of a quantity.
    pub fn bounds(&self, name: &str) -> Option<(f64, f64)> {
        if self.is_float(name) {
            return self.device.float_feature_bounds(name).ok();
        }
        let (low, high) = self.device.integer_feature_bounds(name).ok()?;
        Some((low as f64, high as f64))
    }

    /// Step between the values of a quantity, where there is one.
    pub fn increment(&self, name: &str) -> Option<f64> {
        let step = if self.is_float(name) {
            self.device.float_feature_increment(name).ok()?
        } else {
            self.device.integer_feature_increment(name).ok()? as f64
        };
        // The library says "none" with the smallest number there is.
        (step.is_finite() && step > 1e-9).then_some(step)
    }

    fn is_float(&self, name: &str) -> bool {
        self.node(name).is_some_and(|node| node.is::<GcFloat>())
    }

    /// Reads a quantity.
    pub fn number(&self, name: &str) -> Result<f64, Trouble> {
        let read = if self.is_float(name) {
            self.device.float_feature_value(name)
        } else {
            self.device.integer_feature_value(name).map(|value| value as f64)
        };
        read.map_err(|error| Trouble::new(&error))
    }

    /// Reads text.
    pub fn text(&self, name: &str) -> Result<String, Trouble> {
        let read = self.device.string_feature_value(name);
        read.map(|text| text.to_string()).map_err(|error| Trouble::new(&error))
    }

    /// Reads a feature of the same kind as `like`.
    pub fn read(&self, name: &str, like: &Value) -> Result<Value, Trouble> {
        match like {
            Value::Entry(_) => self.text(name).map(Value::Entry),
            Value::Number(_) => self.number(name).map(Value::Number),
            Value::Switch(_) => self
                .device
                .boolean_feature_value(name)
                .map(Value::Switch)
                .map_err(|error| Trouble::new(&error)),
        }
    }

    /// Writes a feature. What the camera made of it is to be read.
    pub fn write(&self, name: &str, value: &Value) -> Result<(), Trouble> {
        let written = match value {
            Value::Entry(entry) => self.device.set_string_feature_value(name, entry),
            Value::Switch(on) => self.device.set_boolean_feature_value(name, *on),
            Value::Number(number) if self.is_float(name) => {
                self.device.set_float_feature_value(name, *number)
            }
            Value::Number(number) => self.device.set_integer_feature_value(name, number.round() as i64),
        };
        written.map_err(|error| Trouble::new(&error))
    }

    /// Executes a command.
    pub fn execute(&self, name: &str) -> Result<(), Trouble> {
        self.device.execute_command(name).map_err(|error| Trouble::new(&error))
    }

    /// Whether a feature is a switch rather than an enumeration.
    pub fn is_switch(&self, name: &str) -> bool {
        self.node(name).is_some_and(|node| node.is::<GcBoolean>())
    }
}
