"""What every sentence about a mistake must be."""

import pytest

from hyrl_mj import BadArtifact, load_agent


def refused(path, task, message):
    """The agent in a file is refused by its name, in one sentence."""
    with pytest.raises(BadArtifact, match=message) as error:
        load_agent(path, task)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 800


def assert_has_ended(process):
    """A whole run has ended by its verdict: FAILED has exit status 1, as most runs of preset smoke."""
    failed = "\nFAILED: " in process.stdout
    assert process.returncode == int(failed), process.stdout + process.stderr
    assert "Traceback" not in process.stderr


def assert_one_sentence_about(error, path):
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    assert len(text) < 500
