from ..workflows.key_keeper import KeyKeeper as Keeper
from ..workflows.opening import ControlsConfig as Controls
from ..workflows.opening import Device, Fast, device_of, load_named
from ..workflows.opening import EnvironmentConfig as Environment

__all__ = ["Controls", "Device", "Environment", "Fast", "Keeper", "device_of", "load_named"]
