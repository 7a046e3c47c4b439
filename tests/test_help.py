"""What `--help` and the pages say can be typed."""

import shlex
from pathlib import Path

import click
import pytest
from click.shell_completion import BashComplete
from test_cli import call

from topograph.cli.common import main
from topograph.cli.help import EXAMPLES

ROOT = Path(__file__).parent.parent
LINES = [line for lines in EXAMPLES.values() for line in lines]
PAGES = [
    line.strip()
    for page in ("README.md", "docs/index.md", "docs/my_robot.md")
    for line in (ROOT / page).read_text().splitlines()
    if line.strip().startswith("topograph ") and "..." not in line
]


def parsed(line: str) -> click.Context:
    """The context of a line's command; click's own errors come through."""
    words = shlex.split(line.split(" # ")[0].split(" > ")[0])  # a comment may hold an apostrophe
    assert words[0] == "topograph"
    command = main.commands[words[1]]
    return command.make_context(words[1], words[2:])


@pytest.mark.parametrize("line", LINES + PAGES)
def test_examples_parse(line: str) -> None:
    assert parsed(line).command.name == line.split()[1]


def test_an_example_that_does_not_parse_would_be_noticed() -> None:
    with pytest.raises(click.NoSuchOption):
        parsed("topograph map run.bag --output-file orchard.gpkg")


def test_every_command_has_examples_and_groups() -> None:
    without = {"doctor", "warm"}  # they take no words
    assert set(main.commands) - set(EXAMPLES) == without
    shown = call("map", "--help").output
    assert shown.index("--output") < shown.index("How the recording is read") < shown.index("--topic-points")
    assert EXAMPLES["map"][0] in shown
    assert "--topic-points" not in call("export", "--help").output


def test_completion_knows_commands_options_and_choices() -> None:
    complete = BashComplete(main, {}, "topograph", "_TOPOGRAPH_COMPLETE")
    assert {"map", "localize", "live"} <= {c.value for c in complete.get_completions([], "")}
    assert "--check-fixes" in {c.value for c in complete.get_completions(["map", "run.bag"], "--check")}
    assert "trellis" in {c.value for c in complete.get_completions(["simulate", "x.bag", "--design"], "tr")}
    assert {c.value for c in complete.get_completions(["localize", "m", "b", "--measure"], "")} == {
        "both",
        "ranges",
        "bearings",
    }
