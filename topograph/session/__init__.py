"""One run: what it is called, its mountings, its streams as columns. The only thing the rooms above are handed."""

from topograph.session.columns import picked
from topograph.session.driven import Driven
from topograph.session.journal import Journal, Journaled
from topograph.session.scans import ROWS, SECTORS, Scans, ScansBuilder
from topograph.session.session import Session, unknown_mounts
from topograph.session.streams import Streams, StreamsBuilder

__all__ = [
    "ROWS",
    "SECTORS",
    "Driven",
    "Journal",
    "Journaled",
    "Scans",
    "ScansBuilder",
    "Session",
    "Streams",
    "StreamsBuilder",
    "picked",
    "unknown_mounts",
]
