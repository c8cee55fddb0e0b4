"""The scaffold of a new task: a Python file, an MJCF, and the tests that every task must pass."""

import keyword
import re
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

from hyrl_mj.errors import BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.tasks.registry import task_names

TEMPLATES = Path(__file__).with_name("templates")


def write_task(name: str, folder: Path) -> list[Path]:
    """Writes `<name>.py`, `<name>.xml` and `test_<name>.py` into a folder, and returns their paths.

    Nothing is overwritten.

    Raises:
        BadInput: the name is not one of a Python module or is in use, or a file exists already.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise BadInput(
            f"{name!r} cannot be the name of a task: give lower-case letters, digits and _, as my_robot"
        )
    if name in task_names() or find_spec(name) is not None:
        what = "task" if name in task_names() else "Python package"
        raise BadInput(f"there is a {what} {name} already: choose another name")
    title = "".join(part.capitalize() for part in name.split("_"))
    sources = {
        path.name: path.read_text(encoding="utf-8")
        for path in sorted(TEMPLATES.iterdir())
        if path.is_file()
    }
    if title in re.findall(r"\w+", "".join(sources.values()).replace("MyRobot", "")):
        raise BadInput(
            f"the files of a task have another use for the word {title}: choose another name"
        )
    texts = {
        folder / path.replace("my_robot", name): text.replace("my_robot", name).replace(
            "MyRobot", title
        )
        for path, text in sources.items()
    }
    if existing := [path for path in texts if path.exists() or path.is_symlink()]:
        raise BadInput(f"{existing[0]} exists already: choose another name, or another folder")
    token = artifacts.before_writing.set(lambda path, temporary: True)
    try:
        with ExitStack() as stack:  # all are written before one is there
            for path, text in texts.items():
                temporary = stack.enter_context(artifacts.replacing(path))
                temporary.write_text(text, encoding="utf-8")
    finally:
        artifacts.before_writing.reset(token)
    return list(texts)
