"""The package is imported on systems that lack what Linux or Unix alone has."""

import subprocess
import sys
from pathlib import Path

import pytest
from processes import PATIENCE

PACKAGE = Path(__file__).parents[1] / "cconv"
LINUX_ALONE = (
    "sched_getaffinity",
    "sched_setaffinity",
    "memfd_create",
    "pidfd_open",
    "eventfd",
    "posix_fadvise",
    "splice",
)
UNIX_ALONE = "fcntl", "resource", "termios"
IMPORT = f"""
import ast, os, sys
from importlib import import_module
from pathlib import Path

package, modules = Path({str(PACKAGE)!r}), []
used = {{
    name
    for path in package.rglob("*.py")
    for node in ast.walk(ast.parse(path.read_text()))
    for name in ([alias.name for alias in node.names] if isinstance(node, ast.Import)
                 else [node.module] if isinstance(node, ast.ImportFrom) else [])
    if not name.startswith("cconv") and name not in {UNIX_ALONE!r}
}}
for name in sorted(used):  # libraries may use what they like
    import_module(name)
for name in {UNIX_ALONE!r}:
    sys.modules[name] = None
for name in {LINUX_ALONE!r}:
    vars(os).pop(name, None)
for path in sorted(package.rglob("*.py")):
    if path.name != "__main__.py":
        parts = path.relative_to(package.parent).with_suffix("").parts
        import_module(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
        modules.append(path)
from cconv.data.side_by_side import available_cores
assert available_cores() == (os.cpu_count() or 1)
print(len(modules))
"""


@pytest.mark.integration
def test_every_module_is_imported_without_what_linux_or_unix_alone_has():
    command = [sys.executable, "-W", "ignore", "-c", IMPORT]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert finished.returncode == 0, finished.stderr
    assert int(finished.stdout) > 100


def test_files_of_the_system_are_asked_for_before_they_are_read():
    """`/proc` is Linux's: where it is named, the same file says what happens without it."""
    guards = {"evaluation/memory.py": "is_file()", "study/records/environment.py": "except OSError"}
    named = {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in PACKAGE.rglob("*.py")}
    using = {name for name, text in named.items() if '"/proc' in text or "'/proc" in text}
    assert using == set(guards)
    assert all(guard in named[name] for name, guard in guards.items())
