"""YAML 1.2 (core schema) read safely, with the line and column of every key and value.

Plain YAML readers forget where a value was, let a second key of the same name win silently, read
`no` as false and `010` as 8, and can be made to fill the memory by a few nested aliases. This one
takes mappings, lists, text, numbers, true/false and null, with anchors, aliases and merge keys.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from bodyscan.files.reading import read_regular

MAX_BYTES = 1_000_000
MAX_NODES = 100_000  # counted after aliases are followed, which stops alias bombs
MAX_DEPTH = 40

Where: TypeAlias = tuple[str | int, ...]

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _PlainLoader(_Loader):  # type: ignore[misc]  # the stubs know no CSafeLoader
    """Resolves nothing by itself: `parse_scalar` decides what a plain scalar means."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 (PyYAML's own name and type)


@dataclass(frozen=True)
class Place:
    """Line and column, both from 1."""

    line: int
    column: int


@dataclass(frozen=True)
class YamlProblem:
    """What is wrong with a file, and where; path: such as `pairs[2].camera.width`, or empty."""

    place: Place
    path: str
    text: str


class YamlError(Exception):
    """The file cannot be read at all."""

    def __init__(self, problem: YamlProblem) -> None:
        super().__init__(problem.text)
        self.problem = problem


@dataclass
class Document:
    """Plain data (dict, list, str, int, float, bool, None), and where each part of it is.

    values, keys: place of the value, and of the key, at a path of keys and indices.
    raw: the text of plain scalars as written.
    problems: what is wrong but does not make the file unreadable.
    """

    data: Any = None
    values: dict[Where, Place] = field(default_factory=dict)
    keys: dict[Where, Place] = field(default_factory=dict)
    raw: dict[Where, str] = field(default_factory=dict)
    problems: list[YamlProblem] = field(default_factory=list)

    def at(self, where: Where) -> Any:
        """The data at `where`, None if there is none."""
        value = self.data
        for part in where:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def place(self, where: Where, *, of_key: bool = False) -> Place:
        """The place of what is at `where`, or of the nearest thing around it."""
        if of_key and where in self.keys:
            return self.keys[where]
        while where not in self.values and where:
            where = where[:-1]
        return self.values.get(where, Place(1, 1))


def read_yaml(path: Path) -> Document:
    """Read one YAML document.

    Raises YamlError if it is unreadable, BadInput if it is not a regular file, OSError if it does
    not exist or is too long.
    """
    content = read_regular(path, MAX_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = content[: error.start].split(b"\n")
        place = Place(len(before), len(before[-1]) + 1)
        raise _make_error(place, "is not UTF-8 text: save it as UTF-8") from None
    return parse_yaml(text)


def parse_yaml(text: str, max_nodes: int = MAX_NODES, *, foreign: bool = False) -> Document:
    """Parse one YAML document.

    max_nodes: how many values it may hold.
    foreign: as other programs write it: OpenCV's head `%YAML:1.0` and tags are passed over, and of
        several documents the first is taken.

    Raises YamlError if it is unreadable.
    """
    if foreign:
        text = re.sub(r"\A\s*%YAML[^\n]*", lambda head: "\n" * head[0].count("\n"), text)
    try:
        _refuse_deep(text, only_first=foreign)
        compose = yaml.compose_all if foreign else lambda *args: iter([yaml.compose(*args)])
        node = next(iter(compose(text, _PlainLoader)), None)
    except yaml.MarkedYAMLError as error:
        place = _convert_mark(error.problem_mark or error.context_mark)
        near = text.splitlines()[max(place.line - 2, 0) : place.line]
        odd = next(filter(None, map(_find_odd_letter, reversed(near))), "")
        raise _make_error(place, f"is not YAML: {odd}" if odd else _describe(error)) from None
    except yaml.YAMLError as error:
        raise _make_error(Place(1, 1), f"is not YAML: {error}".splitlines()[0]) from None
    document = Document()
    if node is not None:
        document.data = _Builder(document, max_nodes, foreign).build(node, (), 0)
    return document


def format_dotted_path(where: Where) -> str:
    """`('pairs', 2, 'camera')` as `pairs[2].camera`."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where)
    return text.removeprefix(".")


def dump_yaml(data: Any) -> str:
    """Plain data as YAML that `read_yaml` reads back unchanged; keys in the order given."""
    return str(
        yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100, indent=2)
    )


class _Dumper(yaml.SafeDumper):
    """Quotes any text that would be read as something else."""


def _represent_text(dumper: _Dumper, text: str) -> yaml.Node:
    plain = parse_scalar(text) == text and text.isprintable() and not _find_odd_letter(text)
    style = None if plain else '"'
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _represent_text)


class _Builder:
    """Turns nodes into plain data and records their places."""

    def __init__(self, document: Document, max_nodes: int, foreign: bool) -> None:
        self.document, self.max_nodes, self.foreign, self.nodes = document, max_nodes, foreign, 0

    def build(self, node: yaml.Node, where: Where, depth: int) -> Any:
        self.nodes += 1
        place = _convert_mark(node.start_mark)
        if self.nodes > self.max_nodes:
            text = f"has more than {self.max_nodes:,} values once aliases are followed"
            raise _make_error(place, text)
        if depth > MAX_DEPTH:
            raise _make_error(place, f"is nested more than {MAX_DEPTH} deep")
        self.document.values[where] = place
        kinds = {"str": yaml.ScalarNode, "seq": yaml.SequenceNode, "map": yaml.MappingNode}
        if not self.foreign and not isinstance(
            node, kinds.get(node.tag.removeprefix("tag:yaml.org,2002:"), ())
        ):
            self._problem(place, where, f"has the tag {node.tag!r}: write the value without a tag")
            return None
        if isinstance(node, yaml.ScalarNode):
            if node.style:
                return node.value
            self.document.raw[where] = node.value
            if (odd := _find_odd_letter(node.value)) and not self.foreign:
                self._problem(place, where, odd)
            return parse_scalar(node.value)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, where, depth)
        items = enumerate(node.value)
        return [self.build(item, (*where, index), depth + 1) for index, item in items]

    def _mapping(self, node: yaml.MappingNode, where: Where, depth: int) -> dict[str, Any]:
        keys: set[str] = set()
        for key, _ in node.value:
            place = _convert_mark(key.start_mark)
            if not isinstance(key, yaml.ScalarNode):
                self._problem(place, where, "has a key that is not text")
                continue
            if key.value in keys:
                text = f"is given twice in the same place: one of the two '{key.value}' must go"
                self._problem(place, (*where, key.value), text)
            if (odd := _find_odd_letter(key.value)) and not key.style and not self.foreign:
                self._problem(place, (*where, key.value), odd)
            keys.add(key.value)
        result = {}
        for name, (key, value) in self._entries(node, where, depth).items():
            self.document.keys[*where, name] = _convert_mark(key.start_mark)
            result[name] = self.build(value, (*where, name), depth + 1)
        return result

    def _entries(
        self, node: yaml.MappingNode, where: Where, depth: int
    ) -> dict[str, tuple[yaml.Node, yaml.Node]]:
        """Keys and values of a mapping, after those of mappings that it merges."""
        if depth > MAX_DEPTH or self.nodes > self.max_nodes:
            raise _make_error(_convert_mark(node.start_mark), "merges (<<) too much")
        direct: dict[str, tuple[yaml.Node, yaml.Node]] = {
            k.value: (k, v) for k, v in node.value if isinstance(k, yaml.ScalarNode)
        }
        if "<<" not in direct or getattr(direct["<<"][0], "style", None):
            return direct
        _, merged = direct.pop("<<")
        entries: dict[str, tuple[yaml.Node, yaml.Node]] = {}
        for base in merged.value if isinstance(merged, yaml.SequenceNode) else [merged]:
            if isinstance(base, yaml.MappingNode):
                self.nodes += 1 + len(base.value)
                entries = self._entries(base, where, depth + 1) | entries
            else:
                self._problem(_convert_mark(base.start_mark), where, "can merge (<<) only mappings")
        return entries | direct

    def _problem(self, place: Place, where: Where, text: str) -> None:
        self.document.problems.append(YamlProblem(place, format_dotted_path(where), text))


def parse_scalar(text: str) -> Any:
    """The value of a plain scalar by the core schema of YAML 1.2 (section 10.3.2), or OpenCV's NaN."""
    if re.fullmatch(r"~|null|Null|NULL|", text):
        return None
    if re.fullmatch(r"true|True|TRUE|false|False|FALSE", text):
        return text.lower() == "true"
    if re.fullmatch(r"[-+]?[0-9]{1,400}", text):
        return int(text)
    if re.fullmatch(r"0o[0-7]{1,100}|0x[0-9a-fA-F]{1,100}", text):
        return int(text[2:], 8 if text[1] == "o" else 16)
    if re.fullmatch(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", text):
        return float(text)
    if re.fullmatch(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN|Nan)", text):
        return float(text.replace(".", "").lower())
    return text


def _find_odd_letter(text: str) -> str:
    """Describe a letter that looks like a space, quote or minus of YAML without being one, or ""."""
    spaces, quotes = "\u00a0\u2007\u202f\u200b\ufeff\u3000", "\u201c\u201d\u201e\u2018\u2019"
    found = re.search(rf"[{spaces}]|^(?:[{quotes}]|[\u2212\u2013](?=[.0-9]))", text)
    if found is None:
        return ""
    name = f"a {unicodedata.name(found[0]).lower()} (U+{ord(found[0]):04X})"
    return f"has {name}: type it anew, or put the value in plain quotes if it is meant"


def _refuse_deep(text: str, *, only_first: bool) -> None:
    """Check the depth by events: composing is recursive, and a deep file would exhaust the stack."""
    depth = 0
    for event in yaml.parse(text, Loader=_PlainLoader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise _make_error(
                _convert_mark(event.start_mark), f"is nested more than {MAX_DEPTH} deep"
            )
        if only_first and isinstance(event, yaml.DocumentEndEvent):
            return


def _convert_mark(mark: Any) -> Place:
    return Place(mark.line + 1, mark.column + 1) if mark else Place(1, 1)


def _describe(error: yaml.MarkedYAMLError) -> str:
    text = ", ".join(part for part in (error.context, error.problem) if part)
    if "nesting depth" in text:  # PyYAML 6.0.4 has a limit of its own, and reaches it first
        return f"is nested more than {MAX_DEPTH} deep"
    tab = "\\t" in text or "cannot start any token" in text
    advice = " (indent with spaces, never with tabs)" if tab else ""
    return f"is not YAML: {text}{advice}"


def _make_error(place: Place, text: str) -> YamlError:
    return YamlError(YamlProblem(place, "", text))
