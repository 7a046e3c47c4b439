"""All other formats, one table: suffix -> writer."""

from topograph.exchange.table import WRITERS, write
from topograph.exchange.tum import read_tum, write_tum

__all__ = ["WRITERS", "read_tum", "write", "write_tum"]
