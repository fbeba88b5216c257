"""What is refused, one table a package: rows of a call, and words of the one line that it says."""

import inspect

import pytest

from mitsuba_plenoptic import InputError


def refuses(words, call, *arguments, **options):
    """See that a call is refused in one line with these words, a regular expression."""
    with pytest.raises(InputError, match=words) as refused:
        call(*arguments, **options)
    assert "\n" not in str(refused.value)


def refused(*rows):
    """Return a test of rows of a call, which may take an empty folder, and the words that refuse it."""

    @pytest.mark.parametrize(("call", "words"), rows)
    def test(call, words, tmp_path):
        refuses(words, call, *([tmp_path] if "folder" in inspect.signature(call).parameters else []))

    return test
