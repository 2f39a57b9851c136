"""The field's language: words that leave the library and the docs stay away (`python -m tests.language`)."""

import pytest

from tests import language


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
