"""``python -m tests.language``: words without a meaning in the field, per 10,000 lines of library and docs."""

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMITS = {"what": 30.0, "own": 15.0}
"""Largest counts per 10,000 lines."""
BANNED = (
    "told",
    "believed",
    "believes",
    "lies",
    "lying",
    "anew",
    "spoilt",
    "apart",
    "beside",
    "loud",
    "louder",
    "begun",
)
"""The field has nouns for these: configured, prior, inconsistent, again, separate, next to, started."""
OPENINGS = re.compile(r"(?:^|[.:] )(?:Of what|What is)\b")
PARTS = {
    "library": ("jaxnav/*.py", "tuning/*.py"),
    "docs": ("docs/*.md", "README.md", "mkdocs.yml"),
}


def files(part: str) -> Iterator[Path]:
    """Yield the tracked files of a part."""
    names = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", *PARTS[part]], cwd=ROOT, capture_output=True, text=True
    ).stdout
    yield from (ROOT / name for name in names.split() if (ROOT / name).exists())


def found(part: str) -> tuple[dict[str, list[str]], list[str], int]:
    """Return places by word, places of `OPENINGS`, and the number of lines of a part."""
    places: dict[str, list[str]] = {word: [] for word in (*LIMITS, *BANNED)}
    pattern, openings, count = re.compile(rf"\b({'|'.join(places)})\b", re.I), [], 0
    for path in files(part):
        name = str(path.relative_to(ROOT))
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            count += 1
            for word in pattern.findall(line):
                places[word.lower()].append(f"{name}:{number}")
            if OPENINGS.search(line.strip(' "#*-|')):
                openings.append(f"{name}:{number}")
    return places, openings, count


def main() -> None:
    """Print counts, limits and places."""
    for part in PARTS:
        places, openings, count = found(part)
        print(f"{part}: {count} lines; per 10,000")
        for word, at in places.items():
            rate = 1e4 * len(at) / count
            print(f"  {word:10} {rate:6.1f}  (at most {LIMITS.get(word, 0):g})  {', '.join(at[:4])}")
        print(f"  openings   {1e4 * len(openings) / count:6.1f}  (at most 0)  {', '.join(openings[:4])}")


if __name__ == "__main__":
    main()
