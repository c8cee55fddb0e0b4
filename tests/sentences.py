"""What every sentence about a mistake must be."""


def assert_one_sentence_about(error, path):
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    assert len(text) < 500
