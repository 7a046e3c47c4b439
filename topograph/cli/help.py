"""What `--help` shows beside click's own: options in groups, and lines to type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import click

EXAMPLES: Mapping[str, Sequence[str]] = {
    "topograph": (
        "topograph doctor                          # is the installation whole",
        "topograph inspect run.bag                 # what is in it; can `map` run",
        "topograph map run.bag -o orchard.gpkg",
        "topograph localize orchard.gpkg later.bag",
        "topograph view orchard.gpkg --serve",
    ),
    "map": (
        "topograph map run.bag -o orchard.gpkg",
        "topograph map run_0.bag run_1.bag -o orchard.gpkg          # one run in two files",
        "topograph map second.bag --into orchard.gpkg               # a further run of the same orchard",
        "topograph map run.bag --extrinsic velodyne=0.3,0,0.9,0,0,0 --topic-imu none",
        "topograph map run.bag --check-fixes 2                      # how good is the path between fixes",
    ),
    "localize": (
        "topograph localize orchard.gpkg later.bag",
        "topograph localize orchard.gpkg later.bag --from 60 --risk 1e-6",
        "topograph localize orchard.gpkg later.bag --truth reference.tum --method both",
    ),
    "live": (
        "topograph live run.bag -o orchard.gpkg                     # maps as it is driven",
        "topograph live later.bag orchard.gpkg                      # localizes, and extends the map",
        "topograph live orchard.gpkg.journal -o rescued.gpkg        # what a killed run brought",
    ),
    "compare": (
        "topograph compare run1.bag run2.bag --truth run1.truth --truth run2.truth",
        "topograph compare run1.bag run2.bag --truth fixes          # the runs' own GNSS is the truth",
        "topograph compare --suite --designs olive,grid --seeds 7001-7003 --driving stops",
    ),
    "detect": (
        "topograph detect run.bag --picture scan.png --at 30",
        "topograph detect run.bag --front-end thesis --csv trunks.csv",
    ),
    "inspect": ("topograph inspect run.bag", "topograph inspect run_folder --base-frame base_footprint"),
    "export": (
        "topograph export orchard.gpkg trees.geojson",
        "topograph export orchard.gpkg clouds.laz",
        "topograph export orchard.gpkg foxglove.mcap --localization results/latest",
    ),
    "view": (
        "topograph view orchard.gpkg orchard.html                   # one file to send to somebody",
        "topograph view orchard.gpkg --serve --localization results/latest",
    ),
    "simulate": (
        "topograph simulate run1.bag --design olive --run 1         # truth in run1.truth",
        "topograph simulate run2.bag --design trellis --rings 64 --gnss float",
    ),
    "repair": ("topograph repair damaged.gpkg whole.gpkg",),
    "config": ("topograph config > mine.yaml", "topograph config -c thesis --bare"),
    "demo": ("topograph demo demo",),
}
"""Command -> lines to type; a test parses them."""

ARGUMENTS = {
    "BAGS": "A run: .bag, a ROS 2 folder, a lone .mcap or .db3; several files of one run.",
    "RUNS": "A recording each; the first is mapped.",
    "BAG... [MAP": "A run, or the .journal of one that was killed; and a map to localize in and to extend.",
    "MAP": "A map file (.gpkg).",
    "MAP_FILE": "A map file (.gpkg).",
    "OUTPUT": "The file to write.",
    "FOLDER": "Where the results go.",
}
"""Positional words -> what they are."""

RECORDING = frozenset({"extrinsic", "base_frame", "strict", "front_end"})
"""Options that say how a recording is read, besides the topics."""


class Command(click.Command):
    """Options of the recording in a group of their own; examples below."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Click's hook."""
        groups: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": [], "How the recording is read": []}
        for p in self.get_params(ctx):
            if isinstance(p, click.Argument):
                word = p.make_metavar(ctx).strip("[].")
                if word in ARGUMENTS:
                    groups["Arguments"].append((word, ARGUMENTS[word]))
                continue
            record = p.get_help_record(ctx)
            if record is not None:
                reads = p.name in RECORDING or str(p.name).startswith("topic_")
                groups["How the recording is read" if reads else "Options"].append(record)
        for title, records in groups.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Click's hook."""
        write_examples(str(self.name), formatter)


def write_examples(name: str, formatter: click.HelpFormatter) -> None:
    """The lines of a command."""
    if name in EXAMPLES:
        with formatter.section("Examples"):
            for line in EXAMPLES[name]:
                formatter.write(f"  {line}\n")
