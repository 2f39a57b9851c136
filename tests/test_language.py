"""The field's language: words that leave the library and the docs stay away (`python -m tests.language`)."""

import re

import pytest

from tests import language

NAMES = re.compile(r"^def test_(\w+)", re.M)
OPENING = re.compile("(what|who|where|which|how|of|by)_")


@pytest.mark.parametrize("part", language.PARTS)
def test_words_are_those_of_the_field(part):
    places, openings, count = language.found(part)
    assert count > 1000
    for word, at in places.items():
        limit = language.LIMITS.get(word, 0.0)
        assert 1e4 * len(at) / count <= limit, f"{word}: {', '.join(at[:10])}"
    assert not openings


def test_the_count_sees_a_word(tmp_path, monkeypatch):
    (tmp_path / "page.md").write_text("A filter is told its noise.\n\nWhat is smoothed is the error.\n")
    monkeypatch.setattr(language, "ROOT", tmp_path)
    monkeypatch.setattr(language, "files", lambda part: iter([tmp_path / "page.md"]))
    places, openings, count = language.found("docs")
    assert places["told"] == ["page.md:1"] and places["what"] == ["page.md:3"] and openings == ["page.md:3"]
    assert count == 3


def test_names_of_tests_are_sentences_with_a_subject():
    """A noun of the field begins the name, no pronoun or preposition."""
    names = [name for path in (language.ROOT / "tests").rglob("*.py") for name in NAMES.findall(path.read_text())]
    assert len(names) > 1000 and not [name for name in names if OPENING.match(name)]
