"""Client of the polscan structured-light scanner.

    from polscan import Scanner
    cloud = Scanner("http://127.0.0.1:8631").scan(mode="pse").cloud()

`AsyncScanner` is the same for asyncio and trio; `open_bundle` opens a scan on the disk without any service.
Lengths are millimetres, in the frame of the camera: x right, y down, z forward.
"""

from ._async_client import AsyncCalibration, AsyncScan, AsyncScanner
from ._client import Calibration, Scan, Scanner
from .bundle import (
    CLASSES,
    CLOUD,
    EDGE,
    HALF_SATURATED,
    INTERPOLATED,
    INVERTED,
    SILHOUETTE,
    Bundle,
    Maps,
    open_bundle,
    read_cloud,
)
from .errors import (
    BundleError,
    Busy,
    CalibrationFailed,
    Conflict,
    ConnectionLost,
    HashMismatch,
    Invalid,
    NotFound,
    NotReady,
    PolscanError,
    Problem,
    ProtocolError,
    QueueFull,
    ScanFailed,
    Unauthorized,
    WaitTimeout,
)
from .models import (
    Artifact,
    CalibrationInfo,
    CalibrationInUse,
    Calibrations,
    Cause,
    Device,
    Devices,
    Event,
    Preview,
    Progress,
    Readiness,
    ScanInfo,
    Series,
    SessionState,
    SessionView,
    Status,
)
from .report import Plane, Report

__version__ = "0.1.0"

__all__ = [
    "CLASSES",
    "CLOUD",
    "EDGE",
    "HALF_SATURATED",
    "INTERPOLATED",
    "INVERTED",
    "SILHOUETTE",
    "Artifact",
    "AsyncCalibration",
    "AsyncScan",
    "AsyncScanner",
    "Bundle",
    "BundleError",
    "Busy",
    "Calibration",
    "CalibrationFailed",
    "CalibrationInUse",
    "CalibrationInfo",
    "Calibrations",
    "Cause",
    "Conflict",
    "ConnectionLost",
    "Device",
    "Devices",
    "Event",
    "HashMismatch",
    "Invalid",
    "Maps",
    "NotFound",
    "NotReady",
    "Plane",
    "PolscanError",
    "Preview",
    "Problem",
    "Progress",
    "ProtocolError",
    "QueueFull",
    "Readiness",
    "Report",
    "Scan",
    "ScanFailed",
    "ScanInfo",
    "Scanner",
    "Series",
    "SessionState",
    "SessionView",
    "Status",
    "Unauthorized",
    "WaitTimeout",
    "open_bundle",
    "read_cloud",
]
