"""All of a run's settings: YAML in, resolved YAML out; unknown keys are refused by path."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from topograph.bags import BagsConfig
from topograph.errors import UsageError
from topograph.estimate import AverageConfig, EstimateConfig
from topograph.localize import LocalizeConfig, ThesisConfig
from topograph.motion import MotionConfig
from topograph.topomap import TopomapConfig
from topograph.trees import TreesConfig
from topograph.trunks import ThesisTrunksConfig, TrunksConfig


@dataclass(frozen=True, slots=True)
class Config:
    """One block per room."""

    bags: BagsConfig = field(default_factory=BagsConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    trunks: TrunksConfig = field(default_factory=TrunksConfig)
    trees: TreesConfig = field(default_factory=TreesConfig)
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
    topomap: TopomapConfig = field(default_factory=TopomapConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    average: AverageConfig = field(default_factory=AverageConfig)
    thesis: ThesisConfig = field(default_factory=ThesisConfig)
    thesis_trunks: ThesisTrunksConfig = field(default_factory=ThesisTrunksConfig)


class _Loader(yaml.SafeLoader):
    """Safe, and without aliases or repeated keys: both hide what a file says."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise UsageError("aliases are not allowed in a configuration")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(k, deep=True) for k, _ in node.value]
        twice = {k for k in keys if keys.count(k) > 1}
        if twice:
            raise UsageError(f"line {node.start_mark.line + 1}: key {sorted(twice)[0]!r} stands twice")
        return super().construct_mapping(node, deep)


def load(path: Path | None, overrides: dict[str, Any] | None = None) -> Config:
    """Configuration of a YAML file over the defaults, with `overrides` ("room.key" -> value) over both.

    Raises:
        UsageError: the file is missing, not YAML, or has an unknown key or a value of the wrong kind.
    """
    data = {} if path is None else _read(path)
    for key, value in (overrides or {}).items():
        room, _, name = key.partition(".")
        data.setdefault(room, {})[name] = value
    return from_dict(data)


def _read(path: Path) -> dict[str, Any]:
    if not path.exists() and str(path) in PRESETS:
        path = preset(str(path))
    if not path.is_file():
        what = (
            "not a file"
            if path.exists()
            else f"no such file; give a YAML file as `topograph config` prints it, or {' or '.join(PRESETS)}"
        )
        raise UsageError(f"{path}: {what}")
    try:
        data = yaml.load(path.read_text(), _Loader) or {}  # noqa: S506  # a subclass of the safe loader
    except (OSError, yaml.YAMLError, ValueError, TypeError, RecursionError) as err:
        raise UsageError(f"{path}: cannot be read as YAML ({err})") from err
    if not isinstance(data, dict):
        raise UsageError(f"{path}: a configuration is a mapping of rooms; see `topograph config`")
    return data


PRESETS = ("thesis", "thesis_best")
"""Configurations that come with the program; a name stands for the file."""


def preset(name: str) -> Path:
    """The file of a preset: in the wheel beside this module, in a checkout in configs/."""
    here = Path(__file__).parent
    inside = here / "configs" / f"{name}.yaml"
    return inside if inside.exists() else here.parent / "configs" / f"{name}.yaml"


def over(config: Config, name: str) -> Config:
    """A configuration with what a preset sets laid over it."""
    data = _plain(asdict(config))
    for room, block in _read(preset(name)).items():
        data[room] = {**data[room], **block}
    return from_dict(data)


def from_dict(data: dict[str, Any]) -> Config:
    """Configuration of nested mappings; missing keys keep their defaults."""
    rooms = Config.__dataclass_fields__
    for room, block in data.items():
        if room not in rooms:
            raise UsageError(f"configuration: unknown key {room!r}; known are {', '.join(rooms)}")
        known = getattr(Config(), room).__dataclass_fields__
        if block is not None and not isinstance(block, dict):
            raise UsageError(f"configuration: {room} is a block of settings, not {block!r}")
        for key in block or {}:
            if key not in known:
                raise UsageError(f"configuration: unknown key '{room}.{key}'; known are {', '.join(known)}")
    blocks = {}
    for room, block in data.items():
        try:
            blocks[room] = TypeAdapter(type(getattr(Config(), room))).validate_python(block or {})
        except ValidationError as err:
            first = err.errors()[0]
            where = ".".join([room, *(str(w) for w in first["loc"])])
            raise UsageError(f"configuration: {where}: {first['msg']}, not {first['input']!r}") from err
    config = Config(**blocks)
    _consistent(config)
    return config


def _consistent(config: Config) -> None:
    """Settings that must fit each other.

    Raises:
        UsageError: they do not.
    """
    t, c = config.trunks, config.localize
    for low, high, names in (
        (t.low, t.high, "trunks.low, trunks.high"),
        (t.thinnest, t.widest, "trunks.thinnest, trunks.widest"),
        (t.nearest, t.farthest, "trunks.nearest, trunks.farthest"),
        (config.thesis_trunks.z_min, config.thesis_trunks.z_max, "thesis_trunks.z_min, thesis_trunks.z_max"),
    ):
        if low >= high:
            raise UsageError(f"configuration: {names}: {low} is not below {high}")
    if not c.scales or len(c.scales) != len(c.scale_prior):
        raise UsageError("configuration: localize.scales and localize.scale_prior: each scale needs one prior")


def dump(config: Config) -> str:
    """The whole configuration as YAML, defaults included."""
    return yaml.safe_dump(_plain(asdict(config)), sort_keys=False, default_flow_style=None, width=110)


def explained(config: Config) -> str:
    """`dump` with what each setting means, and its unit, as comments: what the settings' own docstrings say."""
    lines: list[str] = []
    for room, block in _plain(asdict(config)).items():
        says = _attributes(getattr(config, room).__doc__ or "")
        lines.append(f"{room}:")
        for key, value in block.items():
            if key in says:
                lines += [f"  # {line}" for line in wrap(says[key], 110)]
            text = yaml.safe_dump(value, default_flow_style=True, width=10**6).removesuffix("...\n").strip()
            lines.append(f"  {key}: {text}")
    return "\n".join(lines) + "\n"


def _attributes(doc: str) -> dict[str, str]:
    """Name -> text of a docstring's `Attributes:`; a line may name several."""
    out: dict[str, str] = {}
    names: list[str] = []
    for line in doc.partition("Attributes:")[2].splitlines():
        head, colon, text = line.strip().partition(":")
        words = [w.strip(" `") for w in head.split(",")]
        if colon and all(w.isidentifier() for w in words):
            names = words
            out |= dict.fromkeys(names, text.strip())
        elif names and line.strip():
            out |= {n: f"{out[n]} {line.strip()}" for n in names}
    return out


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    return value
