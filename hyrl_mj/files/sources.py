"""The files of code that a task is made of: that which defines it, and those beside it that it imports."""

import ast
import re
import sys
from functools import lru_cache
from hashlib import sha256
from importlib.machinery import (
    BYTECODE_SUFFIXES,
    EXTENSION_SUFFIXES,
    SOURCE_SUFFIXES,
    ExtensionFileLoader,
    FileFinder,
    SourceFileLoader,
    SourcelessFileLoader,
    all_suffixes,
)
from itertools import product
from pathlib import Path
from types import CodeType, ModuleType

from hyrl_mj.errors import BadInput

# The folders of the files from which code is compiled each time.
_FOLDERS: set[str] = set()
# The names of folders of installed packages.
_INSTALLED = ("site-packages", "dist-packages")


def modules_in(folder: Path) -> list[Path]:
    """Returns the files of the modules in a package, without those that Python itself compiles."""
    files = (f for f in folder.rglob("*") if f.name.endswith(tuple(all_suffixes())))
    return sorted(f for f in files if f.is_file() and f.parent.name != "__pycache__")


def sources(path: Path) -> list[Path]:
    """Returns a file of code, all others of its package if it begins one, and those beside that they name.

    They name modules in import statements, and in entry points.
    """
    parts = modules_in(path.parent) if path.name == "__init__.py" else []
    root = path.parent.parent if parts else path.parent
    found = dict.fromkeys([path, *parts])
    # Among installed packages everything lies beside everything.
    left = [] if root.name in _INSTALLED else [*found]
    looked: set[tuple[Path, str]] = set()
    while left:
        file = left.pop()
        names = _imported(file.read_bytes()) if file.suffix == ".py" else ()
        places = {*product({root, path.parent, file.parent}, names)} - looked
        looked |= places
        for folder, name in places:
            # Compiled modules, too: Python takes them before those of the same name.
            files = [folder / f"{name}{suffix}" for suffix in all_suffixes()]
            files += modules_in(folder / name)
            new = [f for f in files if f.is_file() and f not in found]
            found |= dict.fromkeys(new)
            left += new
    del found[path]
    return [path, *sorted(found)]  # sets are in another order in another process


class FromSource(SourceFileLoader):
    """Compiles a file each time: compiled code in `__pycache__` may be of anybody, and is not hashed."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def compile_each_time(path: Path) -> None:
    """Has a file of code, and what `sources` finds with it, compiled where it is imported from now on."""
    files = sources(path)
    folders = {str(file.parent) for file in files}
    folders |= {str(file.parent.parent) for file in files if file.name == "__init__.py"}
    if _finder not in sys.path_hooks:
        sys.path_hooks.insert(0, _finder)
    for folder in folders - _FOLDERS:
        sys.path_importer_cache.pop(folder, None)
    _FOLDERS.update(folder for folder in folders if Path(folder).name not in _INSTALLED)


def _finder(folder: str) -> FileFinder:
    """Returns what finds the modules in a folder of `_FOLDERS`; raises ImportError for others."""
    if folder not in _FOLDERS:
        raise ImportError
    return FileFinder(
        folder,
        (ExtensionFileLoader, EXTENSION_SUFFIXES),
        (FromSource, SOURCE_SUFFIXES),
        (SourcelessFileLoader, BYTECODE_SUFFIXES),
    )


def digest_of(path: Path) -> str:
    """Returns the SHA-256 of a file of code and of those beside it that it imports."""
    digest = sha256()
    for file in sources(path):
        digest.update(sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def check_helpers(path: Path) -> None:
    """Raises `BadInput` if Python has a module of another place that is called as one beside a task.

    It would give that one to the task.
    """
    for name in _beside(path):
        module = sys.modules.get(name)
        places = [getattr(module, "__file__", None), *getattr(module, "__path__", [])]
        places = [str(Path(place).resolve()) for place in places if place]
        own = str(path.parent.resolve() / name)
        if places and not any(place == f"{own}.py" or place.startswith(own) for place in places):
            raise BadInput(
                f"{path} imports {name}, which lies beside it, and this process has another module of that "
                f"name, {places[0]}: rename {name}"
            )


def helpers(path: Path) -> dict[str, ModuleType]:
    """Returns the modules that were imported of those beside a task that it imports, by name."""
    names = _beside(path)
    return {m: module for m, module in sys.modules.items() if m.partition(".")[0] in names}


def forget_helpers(path: Path) -> dict[str, ModuleType]:
    """Lets what a task imports from its folder be imported anew; returns what was imported so far."""
    found = helpers(path)
    for module in found:
        del sys.modules[module]
    return found


def _beside(path: Path) -> set[str]:
    """Returns the names of the modules and packages beside a task that it imports."""
    files = [file for file in sources(path)[1:] if file.is_relative_to(path.parent)]
    return {file.relative_to(path.parent).parts[0].partition(".")[0] for file in files}


@lru_cache(maxsize=1_000)
def _imported(code: bytes) -> frozenset[str]:
    """Returns the first names of the modules that the code of a file imports, or names to be imported."""
    try:
        tree = ast.parse(code)
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # which running it tells of
        return frozenset()
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [node.module] if node.module else [alias.name for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # An entry point, as gymnasium.register takes it.
            names += re.findall(r"\A([^\W\d][\w.]*):[^\W\d][\w.]*\Z", node.value)
        elif isinstance(node, ast.Call) and "import_module" in (
            getattr(node.func, "attr", ""),
            getattr(node.func, "id", ""),
        ):
            texts = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
            names += [text.lstrip(".") for text in texts if isinstance(text, str)]
    # This package may lie beside a task, too.
    return frozenset(name.partition(".")[0] for name in names) - {"hyrl_mj", ""}
