"""The checker of words finds them where they stand, and nowhere else."""

from __future__ import annotations

from pathlib import Path

from check_words import forbidden_in, read_glossary

GLOSSARY = """
| word | meaning | in the field | do not write | source |
|---|---|---|---|---|
| offset | what is left | residual | `stands off`, wiggle (of a line) | here |

## Never as a part of a name

| part | write | except |
|---|---|---|
| told, held | estimated | held_out_boards |
"""
MODULE = '''"""Say where a pole stands
off."""

held_out_boards = 3  # held, here, is a word like any other
told_mm = f"the wiggle of pole {held_out_boards} is large"


def wiggle_room(held: int) -> None:
    """Return `wiggle`, a name in a text."""
'''


def test_words_are_found_in_names_and_in_prose(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(MODULE, "utf-8")
    phrases, parts = read_glossary(GLOSSARY)
    assert (phrases, sorted(parts)) == (["stands off", "wiggle"], ["held", "told"])
    found = forbidden_in(tmp_path / "module.py", phrases, parts, shown="m.py")
    assert sorted(found) == [
        "m.py:1: the text has `stands off`",
        "m.py:5: `told_mm` has the word `told`",
        "m.py:5: the text has `wiggle`",
        "m.py:8: `held` has the word `held`",
        "m.py:8: `wiggle_room` has the word `wiggle`",
    ]
