"""YAML 1.2 (core schema) read safely, with the line and column of every key and value.

Plain YAML readers forget where a value was, let a second key of the same name win silently, read
`no` as false and `010` as 8, and can be made to fill the memory by a few nested aliases. This one
takes mappings, lists, text, numbers, true/false and null, with anchors, aliases and merge keys.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from bodyscan.files.regular import read_regular

MOST_BYTES = 1_000_000
MOST_NODES = 100_000  # counted after aliases are followed, which stops alias bombs
MOST_DEPTH = 40

Where: TypeAlias = tuple[str | int, ...]

_NULL = re.compile(r"(~|null|Null|NULL|)")
_TRUE, _FALSE = re.compile(r"true|True|TRUE"), re.compile(r"false|False|FALSE")
_INT = re.compile(r"[-+]?[0-9]{1,400}")
_BASED_INT = re.compile(r"0o[0-7]{1,100}|0x[0-9a-fA-F]{1,100}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"([-+]?)\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_KINDS = {"str": yaml.ScalarNode, "seq": yaml.SequenceNode, "map": yaml.MappingNode}

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _PlainLoader(_Loader):  # type: ignore[misc]  # the stubs know no CSafeLoader
    """Resolves nothing by itself: `_scalar` decides what a plain scalar means."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 (PyYAML's own name and type)


@dataclass(frozen=True)
class Place:
    """Line and column, both from 1."""

    line: int
    column: int


@dataclass(frozen=True)
class YamlProblem:
    """What is wrong with a file, and where; `path`, such as
    `pairs[2].camera.width`, may be empty."""

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
    not exist.
    """
    content = read_regular(path, MOST_BYTES)
    if len(content) > MOST_BYTES:
        raise _error(Place(1, 1), f"is longer than {MOST_BYTES:,} bytes: this cannot be right")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = content[: error.start].split(b"\n")
        place = Place(len(before), len(before[-1]) + 1)
        raise _error(place, "is not UTF-8 text: save it as UTF-8") from None
    try:
        _refuse_deep(text)
        node = yaml.compose(text, Loader=_PlainLoader)
    except yaml.MarkedYAMLError as error:
        raise _error(_mark(error.problem_mark or error.context_mark), _words(error)) from None
    except yaml.YAMLError as error:
        raise _error(Place(1, 1), f"is not YAML: {error}".splitlines()[0]) from None
    document = Document()
    if node is not None:
        _refuse_many(node, {})
        document.data = _Builder(document).build(node, (), 0)
    return document


def dotted_path(where: Where) -> str:
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
    style = None if _scalar(text) == text and text.isprintable() else '"'
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _represent_text)


class _Builder:
    """Turns nodes into plain data and records their places."""

    def __init__(self, document: Document) -> None:
        self.document, self.nodes = document, 0

    def build(self, node: yaml.Node, where: Where, depth: int) -> Any:
        self.nodes += 1
        place = _mark(node.start_mark)
        if self.nodes > MOST_NODES:
            raise _too_many(place)
        if depth > MOST_DEPTH:
            raise _error(place, f"is nested more than {MOST_DEPTH} deep")
        self.document.values[where] = place
        kind = node.tag.removeprefix("tag:yaml.org,2002:")
        if not isinstance(node, _KINDS.get(kind, ())):
            self._problem(place, where, f"has the tag {node.tag!r}: write the value without a tag")
            return None
        if isinstance(node, yaml.ScalarNode):
            if node.style:
                return node.value
            self.document.raw[where] = node.value
            return _scalar(node.value)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, where, depth)
        items = enumerate(node.value)
        return [self.build(item, (*where, index), depth + 1) for index, item in items]

    def _mapping(self, node: yaml.MappingNode, where: Where, depth: int) -> dict[str, Any]:
        entries: dict[str, tuple[yaml.Node, yaml.Node]] = {}
        merged: list[yaml.Node] = []
        for key, value in node.value:
            place = _mark(key.start_mark)
            if not isinstance(key, yaml.ScalarNode):
                self._problem(place, where, "has a key that is not text")
            elif key.value in entries or (key.value == "<<" and merged):
                text = f"is given twice in the same place: one of the two '{key.value}' must go"
                self._problem(place, (*where, key.value), text)
            elif key.value == "<<" and not key.style:
                merged = value.value if isinstance(value, yaml.SequenceNode) else [value]
            else:
                entries[key.value] = (key, value)
        for base in merged:
            if isinstance(base, yaml.MappingNode):
                for name, entry in self._merge_entries(base, depth + 1).items():
                    entries.setdefault(name, entry)
            else:
                self._problem(_mark(base.start_mark), where, "can merge (<<) only mappings")
        result = {}
        for name, (key, value) in entries.items():
            self.document.keys[*where, name] = _mark(key.start_mark)
            result[name] = self.build(value, (*where, name), depth + 1)
        return result

    def _merge_entries(
        self, node: yaml.MappingNode, depth: int
    ) -> dict[str, tuple[yaml.Node, yaml.Node]]:
        """Keys and values of a mapping that another one merges, including what it merges itself."""
        self.nodes += 1 + len(node.value)
        if depth > MOST_DEPTH or self.nodes > MOST_NODES:
            raise _error(_mark(node.start_mark), "merges (<<) too much")
        own = {key.value: (key, value) for key, value in node.value if _is_text(key)}
        merge = own.pop("<<", None)
        bases = [] if merge is None else [merge[1]]
        if bases and isinstance(bases[0], yaml.SequenceNode):
            bases = bases[0].value
        for base in bases:
            if isinstance(base, yaml.MappingNode):
                own = self._merge_entries(base, depth + 1) | own
        return own

    def _problem(self, place: Place, where: Where, text: str) -> None:
        self.document.problems.append(YamlProblem(place, dotted_path(where), text))


def _is_text(node: yaml.Node) -> bool:
    return isinstance(node, yaml.ScalarNode)


def _scalar(text: str) -> Any:
    """The value of a plain scalar by the core schema of YAML 1.2."""
    if _NULL.fullmatch(text):
        return None
    if _TRUE.fullmatch(text) or _FALSE.fullmatch(text):
        return text.lower() == "true"
    if _INT.fullmatch(text):
        return int(text)
    if _BASED_INT.fullmatch(text):
        return int(text[2:], 8 if text[1] == "o" else 16)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _NOT_FINITE.fullmatch(text):
        return float(text.replace(".", "").lower())
    return text


def _refuse_deep(text: str) -> None:
    """Check depth by events first: composing is recursive,
    and a deep file would exhaust the stack."""
    depth = 0
    for event in yaml.parse(text, Loader=_PlainLoader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MOST_DEPTH:
            raise _error(_mark(event.start_mark), f"is nested more than {MOST_DEPTH} deep")


def _refuse_many(node: yaml.Node, sizes: dict[int, int]) -> int:
    """How many values a node stands for once aliases are followed, each counted once: building an
    alias bomb until it is too large would take half a second, for every file of a batch."""
    if id(node) in sizes:
        return sizes[id(node)]
    sizes[id(node)] = 1  # one that contains itself is too deep, which is reported when it is built
    parts: list[yaml.Node] = []
    if isinstance(node, yaml.MappingNode):
        parts = [value for key, value in node.value if key.value != "<<"]
    elif isinstance(node, yaml.SequenceNode):
        parts = node.value
    sizes[id(node)] += sum(_refuse_many(part, sizes) for part in parts)
    if sizes[id(node)] > MOST_NODES:
        raise _too_many(_mark(node.start_mark))
    return sizes[id(node)]


def _too_many(place: Place) -> YamlError:
    return _error(place, f"has more than {MOST_NODES:,} values once aliases are followed")


def _mark(mark: Any) -> Place:
    return Place(mark.line + 1, mark.column + 1) if mark else Place(1, 1)


def _words(error: yaml.MarkedYAMLError) -> str:
    said = ", ".join(part for part in (error.context, error.problem) if part)
    if "nesting depth" in said:  # PyYAML 6.0.4 has a limit of its own, and reaches it first
        return f"is nested more than {MOST_DEPTH} deep"
    tab = "\\t" in said or "cannot start any token" in said
    advice = " (indent with spaces, never with tabs)" if tab else ""
    return f"is not YAML: {said}{advice}"


def _error(place: Place, text: str) -> YamlError:
    return YamlError(YamlProblem(place, "", text))
