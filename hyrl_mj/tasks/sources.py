"""The files of code that a task is made of: that which defines it, and those beside it that it imports."""

import ast
import sys
from hashlib import sha256
from pathlib import Path

from hyrl_mj.errors import BadInput

OWN = "hyrl_mj"  # this package may lie beside a task, too
INSTALLED = "site-packages", "dist-packages"  # in these folders everything lies beside everything


def sources(path: Path) -> list[Path]:
    """Returns a file of code, and the files in its folder that it imports, by whatever way."""
    found, left = {path: None}, [] if path.parent.name in INSTALLED else [path]
    while left:
        for name in _imported(left.pop()):
            files = [path.with_name(f"{name}.py"), *sorted((path.parent / name).rglob("*.py"))]
            new = [file for file in files if file.is_file() and file not in found]
            found |= dict.fromkeys(new)
            left += new
    return list(found)


def digest_of(path: Path) -> str:
    """Returns the SHA-256 of a file of code and of those beside it that it imports."""
    digest = sha256()
    for file in sources(path):
        digest.update(sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def forget_helpers(path: Path) -> None:
    """Lets what a task imports from its folder be imported anew.

    Raises:
        BadInput: Python has a module of such a name from another place, and would give that one.
    """
    for file in sources(path)[1:]:
        if file.parent != path.parent and file.name != "__init__.py":
            continue
        name = file.stem if file.parent == path.parent else file.parent.name
        other = getattr(sys.modules.get(name), "__file__", None)
        if other is None:
            continue
        if Path(other).resolve() != file.resolve():
            raise BadInput(
                f"{path} imports {name}, which lies beside it, and this process has another module of that "
                f"name, {other}: rename {file.name}"
            )
        del sys.modules[name]


def _imported(path: Path) -> set[str]:
    """Returns the names of the top-level modules that a file imports anywhere."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):  # which running it tells of
        return set()
    names = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    names |= {
        node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module and not node.level
    }
    return {name.partition(".")[0] for name in names} - {OWN}
