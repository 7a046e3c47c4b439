"""The one place where open3d is imported: late, for it takes long, and with the library that bare systems lack."""

from __future__ import annotations

import ctypes
import functools
import logging
from typing import Any

from topograph.errors import UsageError

log = logging.getLogger(__name__)


@functools.lru_cache(maxsize=1)
def open3d() -> Any:
    """The open3d module. Where Debian lacks libusb-1.0, PyPI's copy of it is loaded first.

    Raises:
        UsageError: it is not installed.
    """
    try:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):  # elsewhere than on Linux open3d needs no help
        log.debug("libusb_package is not to be had")
    try:
        import open3d as o3d
    except (ImportError, OSError) as err:  # not there, or a library of the system that it needs
        raise UsageError(f"the thesis's front end needs open3d ({err}): pip install 'topograph[thesis]'") from err
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    return o3d
