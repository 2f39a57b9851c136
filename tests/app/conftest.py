"""What a user gets as a warning is a failure here."""

import pytest

from jaxnav.app import results


@pytest.fixture(autouse=True)
def pictures_are_drawn(monkeypatch):
    """A verb goes on without a picture that cannot be drawn; a test of it does not."""

    def fail(text: str) -> None:
        raise AssertionError(text)

    monkeypatch.setattr(results, "stderr", fail)
