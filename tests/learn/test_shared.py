"""What tests of this room share is whole, or made anew."""

from __future__ import annotations

import pytest


def test_what_ended_half_made_is_made_anew(shared):
    def ends(folder):
        folder.mkdir()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        shared("half-made", ends)
    folder, facts = shared("half-made", lambda folder: folder.mkdir() or {"whole": True})
    assert folder.is_dir() and facts == {"whole": True}
    assert shared("half-made", ends) == (folder, facts)
