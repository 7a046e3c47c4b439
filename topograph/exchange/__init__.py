"""All other formats, one table: suffix -> writer."""

from topograph.exchange.geotiff import Underlay, check_picture, read_underlay
from topograph.exchange.localized import Localized, read_localization
from topograph.exchange.table import WRITERS, write
from topograph.exchange.tables import geodataframe, topomap_of
from topograph.exchange.tum import read_tum, write_tum, write_wide_tum

__all__ = [
    "WRITERS",
    "Localized",
    "Underlay",
    "check_picture",
    "geodataframe",
    "read_localization",
    "read_tum",
    "read_underlay",
    "topomap_of",
    "write",
    "write_tum",
    "write_wide_tum",
]
