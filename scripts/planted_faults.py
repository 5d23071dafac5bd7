"""Plant some sixty faults in copies of the package, one at a time, and report which test catches each.

    python scripts/planted_faults.py --check                        # all faults still apply; a few seconds
    python scripts/planted_faults.py --list                         # what they are
    python scripts/planted_faults.py --jobs 2 --out report.json     # all of them; up to two minutes each
    python scripts/planted_faults.py --only obj_upside_down --limit 300

Each copy runs the tests of ``make test`` (not slow, not long, not gpu): first the tests of the fault's own room, then tests of
related rooms, then all others, until the first failure or for ``--limit`` seconds. A failing test is run once more
without the fault: if it fails there too it is ignored, and the copy continues without it. Verdicts:

    caught     a test failed, or its process died, because of the fault
    survived   all tests passed
    time       nothing failed within the limit
    broken     the tests cannot be collected, so no test can find the fault

Exit code 0 if at least ``--least`` faults (57, or all if fewer are chosen) were caught. The faults are in
``planted_faults_table.py``.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import contextlib
import copy
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from planted_faults_table import FAULTS, Fault

TREE = Path(__file__).resolve().parents[1]
MARKERS = "not slow and not long and not gpu"
#: Number of faults of the table that the tests must catch.
LEAST = 57
#: Test of the table itself: it fails in every copy, as the anchor of the fault is gone.
IGNORED = "test_planted_faults.py"
#: Folders copied from a tree that is not a git checkout.
COPIED = ("torchpt", "tests", "configs", "scenes", "scripts", "docs", ".ci", ".github")
#: Plugin that notes the running test, and the first failing one, beside the copy.
PLUGIN = """
import json, os

_FILE = os.environ["PLANTED_FAULTS_NOTE"]


def _note(**facts):
    with open(_FILE, "w", encoding="utf-8") as file:
        json.dump(facts, file)


def pytest_runtest_logstart(nodeid, location):
    _note(test=nodeid, failed=False, message="")


def pytest_runtest_logreport(report):
    if report.failed:
        crash = getattr(getattr(report.longrepr, "reprcrash", None), "message", "") or report.longreprtext[-300:]
        _note(test=report.nodeid, failed=True, message=" ".join(crash.split())[:300])
"""


class MissingError(Exception):
    """A fault that cannot be planted."""


# -- where a fault goes


@dataclass(frozen=True)
class Site:
    """The target of a fault: a file, the expression in it, and the top-level statement that contains it."""

    path: Path
    source: str
    node: ast.expr
    whole: ast.stmt

    def planted(self, after: str) -> str:
        """Return the source with another expression in place of this one; all else stays as it is.

        Raises:
            MissingError: the result differs from the intended syntax tree.
        """
        lines = self.source.encode().splitlines(keepends=True)
        row, column, last_row, last_column = _extent(self.node)
        begun, rest = lines[row - 1][:column], lines[last_row - 1][last_column:]
        middle = begun + b"(" + after.encode() + b")" + rest
        # Nothing but the one statement can have changed.
        first, last = _first_line(self.whole), self.whole.end_lineno
        made = ast.parse(b"".join((*lines[first - 1 : row - 1], middle, *lines[last_row:last])))
        meant = _Replaced(self.node, after).visit(copy.deepcopy(self.whole))
        if ast.dump(made) != ast.dump(ast.Module([meant], [])):
            raise MissingError(f"{self.path}: {after!r} cannot stand there")
        return b"".join((*lines[: row - 1], middle, *lines[last_row:])).decode()


class _Replaced(ast.NodeTransformer):
    """A node transformer that replaces one expression."""

    def __init__(self, node: ast.expr, after: str) -> None:
        self._kind, self._at, self._after = type(node), _extent(node), ast.parse(after, mode="eval").body

    def visit(self, node: ast.AST) -> Any:
        here = type(node) is self._kind and isinstance(node, ast.expr) and _extent(node) == self._at
        return self._after if here else self.generic_visit(node)


def _first_line(node: ast.stmt) -> int:
    """Return the first line of a statement with its decorators."""
    return min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", ()))])


def _extent(node: ast.expr) -> tuple[int, int, int, int]:
    """Return first line and column, last line and column; columns in bytes of UTF-8."""
    assert node.end_lineno is not None and node.end_col_offset is not None
    return node.lineno, node.col_offset, node.end_lineno, node.end_col_offset


class Tree:
    """The parsed package of a checkout."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.sources = {path: path.read_text(encoding="utf-8") for path in sorted((root / "torchpt").rglob("*.py"))}
        self._scopes: dict[Path, dict[str, list[tuple[ast.AST, ast.stmt]]]] = {}

    def site(self, fault: Fault) -> Site:
        """Find the target of a fault, whichever file its function is in.

        Raises:
            MissingError: no function with that name and expression, or more than one.
        """
        wanted = ast.dump(ast.parse(fault.before, mode="eval").body)
        last, functions, found = fault.function.rpartition(".")[2], 0, []
        for path, source in self.sources.items():
            if f"def {last}(" not in source and f"class {last}" not in source:
                continue
            for scope, whole in self._of(path).get(fault.function, ()):
                functions += 1
                nodes = (node for node in ast.walk(scope) if isinstance(node, ast.expr))
                found += [Site(path, source, node, whole) for node in nodes if ast.dump(node) == wanted]
        if len(found) != 1:
            places = ", ".join(f"{s.path.relative_to(self.root)}:{s.node.lineno}" for s in found)
            raise MissingError(
                f"{fault.name}: expected {fault.before!r} once in {fault.function} (last in torchpt/{fault.room}), "
                f"found {f'it at {places}' if found else 'it nowhere'}; there are {functions} functions of that name"
            )
        return found[0]

    def _of(self, path: Path) -> dict[str, list[tuple[ast.AST, ast.stmt]]]:
        """Functions and classes of a file by qualified name, each with the statement of the module that holds it."""
        if path not in self._scopes:
            scopes = self._scopes[path] = {}
            for whole in ast.parse(self.sources[path]).body:
                for name, node in _scopes_of(ast.Module([whole], [])):
                    scopes.setdefault(name, []).append((node, whole))
        return self._scopes[path]


def _scopes_of(node: ast.AST, prefix: str = "") -> Iterator[tuple[str, ast.AST]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield f"{prefix}{child.name}", child
            yield from _scopes_of(child, f"{prefix}{child.name}.")
        else:
            yield from _scopes_of(child, prefix)


def problems(tree: Path, faults: Sequence[Fault] = FAULTS) -> list[str]:
    """Return the reasons why faults do not apply to a tree; empty if all apply."""
    package, found = Tree(tree), []
    for fault in faults:
        try:
            site = package.site(fault)
            site.planted(fault.after)
            if ast.dump(site.node) == ast.dump(ast.parse(fault.after, mode="eval").body):
                found.append(f"{fault.name}: changes nothing")
        except MissingError as error:
            found.append(str(error))
        except SyntaxError as error:
            found.append(f"{fault.name}: {error}")
    return found


# -- running tests on copies


@dataclass
class Result:
    """The result of a fault."""

    name: str
    file: str
    function: str
    verdict: str = ""
    test: str = ""
    message: str = ""
    seconds: float = 0.0
    invalid: list[str] = field(default_factory=list)  # tests that fail without the fault, too

    def __str__(self) -> str:
        said = f"{self.verdict:9}{self.name:32}{self.seconds:6.1f} s  {self.test}"
        said += f"  [{self.message[:100]}]" if self.message else ""
        return said + (f"  (without {', '.join(self.invalid)})" if self.invalid else "")


class Campaign:
    """Copies of a tree, and the tests that run on them.

    Args:
        tree: the checkout.
        scratch: folder for copies.
        limit: time limit for the tests of a fault, in seconds.
    """

    def __init__(self, tree: Path, scratch: Path, limit: float) -> None:
        self.package, self.tree, self.scratch, self.limit = Tree(tree), tree, scratch, limit
        self.clean = scratch / "clean"
        _copy(tree, self.clean)
        compileall.compile_dir(self.clean / "torchpt", quiet=2)  # once for all copies
        (scratch / "planted_faults_plugin.py").write_text(PLUGIN)
        files = (self.clean / "tests").rglob("test_*.py")
        self.tests = {file: file.read_text(encoding="utf-8") for file in files if file.name != IGNORED}
        self._valid: dict[str, bool] = {}
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()

    def take(self, fault: Fault) -> Result:
        """Plant a fault in a copy and run tests until one fails."""
        site = self.package.site(fault)
        file = site.path.relative_to(self.tree)
        result, folder = Result(fault.name, file.as_posix(), fault.function), self.scratch / fault.name
        shutil.copytree(self.clean, folder)
        try:
            (folder / file).write_text(site.planted(fault.after), encoding="utf-8")
            stages = [run for stage in self._stages(fault, file) for run in stage]
            while stages and not result.verdict:
                if self._stage(folder, stages[0], result):
                    stages.pop(0)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        result.verdict = result.verdict or "survived"
        return result

    def stop(self) -> None:
        """End all tests that still run."""
        for process in list(self._running):
            _kill(process)

    def _stage(self, folder: Path, targets: list[str], result: Result) -> bool:
        """Run some tests; return True if their result is final."""
        left = self.limit - result.seconds
        begun = time.monotonic()
        code, note = self._pytest(folder, targets, result.invalid, left)
        result.seconds += time.monotonic() - begun
        if code is None:
            result.verdict = "time"
        elif code in (0, 5):  # 5: all of them are deselected
            return True
        elif not note.get("test") or (code > 0 and not note["failed"]):
            result.verdict, result.message = "broken", f"pytest ended with {code} before a test failed"
        elif self._is_valid(note["test"]):
            died = f"the process died ({code})" if code < 0 else ""
            result.verdict, result.test, result.message = "caught", note["test"], note["message"] or died
        else:
            result.invalid.append(note["test"])
            return False
        return True

    def _is_valid(self, test: str) -> bool:
        """Return True if a test passes without any fault."""
        with self._lock:
            known = self._valid.get(test)
        if known is None:
            code, _ = self._pytest(self.clean, [test], [], 600.0)
            known = code == 0
            with self._lock:
                self._valid[test] = known
        return known

    def _pytest(
        self, folder: Path, targets: Sequence[str], without: Sequence[str], limit: float
    ) -> tuple[int | None, dict[str, str]]:
        """Run pytest; return its exit code (None after a timeout) and the last noted test."""
        with tempfile.NamedTemporaryFile("r", dir=self.scratch, suffix=".json") as note:
            environment = {
                **os.environ,
                "PYTHONPATH": os.pathsep.join((str(folder), str(self.scratch))),
                "PLANTED_FAULTS_NOTE": note.name,
            }
            environment.setdefault("OMP_NUM_THREADS", "1")
            assets = self.tree.parent / "shared" / "assets"  # as in the Makefile
            if assets.is_dir():
                environment.setdefault("TORCHPT_ASSETS", str(assets))
            command = [
                *(sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "planted_faults_plugin"),
                *("-m", MARKERS, *(f"--deselect={test}" for test in without), *targets),
            ]
            with open(os.devnull, "r+b") as nothing:
                process = subprocess.Popen(
                    command, cwd=folder, env=environment, stdin=nothing, stdout=nothing, stderr=nothing,
                    start_new_session=True,
                )  # fmt: skip
            self._running.add(process)
            try:
                code = process.wait(max(limit, 1.0))
            except subprocess.TimeoutExpired:
                code = None
            finally:
                _kill(process)  # and what its tests left behind
                self._running.discard(process)
            text = note.read()
        return code, json.loads(text) if text else {}

    def _stages(self, fault: Fault, file: Path) -> list[list[list[str]]]:
        """Return groups of test files: of the fault's room, of related rooms, and all others.

        In each group, tests named after the module ``file`` come first, then tests that import it.
        """
        own, *others = fault.tests.split()
        *_, stem = module = file.with_suffix("").parts
        dotted, room = ".".join(module), ".".join(module[: 3 if "physics" in module else 2])

        def order(test: Path) -> tuple[int, str]:
            return 0 if stem in test.stem else 1 if dotted in self.tests[test] else 2, test.as_posix()

        importing = {test.parent.name for test, text in self.tests.items() if room in text}
        second = {*others, *importing} - {own, "tests"}
        stages: list[list[Path]] = [[], [], []]
        for test in sorted(self.tests, key=order):
            stages[0 if test.parent.name == own else 1 if test.parent.name in second else 2].append(test)
        return [_apart([test.relative_to(self.clean) for test in stage]) for stage in stages]


def _apart(files: Sequence[Path]) -> list[list[str]]:
    """Split test files among processes: files that fork ranks get a process of their own."""
    ranks = [file.as_posix() for file in files if file.parent.name == "ranks"]
    others = [file.as_posix() for file in files if file.parent.name != "ranks"]
    return [names for names in (ranks, others) if names]


def _copy(tree: Path, to: Path) -> None:
    """Copy all files of a checkout that git tracks or would track."""
    listed = subprocess.run(
        ["git", "-C", str(tree), "ls-files", "-coz", "--exclude-standard"], capture_output=True, check=False
    )
    names = [os.fsdecode(name) for name in listed.stdout.split(b"\0") if name] if listed.returncode == 0 else []
    if not names:
        files = [path for folder in COPIED for path in (tree / folder).rglob("*") if "__pycache__" not in path.parts]
        files += [path for path in tree.iterdir() if path.is_file()]
        names = [str(path.relative_to(tree)) for path in files if path.is_file()]
    for name in names:
        if (tree / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(tree / name, to / name)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and all its children."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


# -- the command


def run(tree: Path, faults: Sequence[Fault], jobs: int, limit: float, out: Path | None) -> list[Result]:
    """Run all faults, print a line for each as its result is known, and update the report."""
    results: dict[str, Result] = {}
    with tempfile.TemporaryDirectory(prefix="planted-faults-") as folder:
        campaign = Campaign(tree, Path(folder), limit)
        pool = ThreadPoolExecutor(jobs)
        try:
            for future in as_completed([pool.submit(campaign.take, fault) for fault in faults]):
                result = future.result()
                results[result.name] = result
                print(result, flush=True)
                if out is not None:
                    out.write_text(json.dumps(report(tree, limit, list(results.values())), indent=1))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            campaign.stop()
            pool.shutdown()
    return [results[fault.name] for fault in faults]


def report(tree: Path, limit: float, results: Sequence[Result]) -> dict[str, object]:
    """Return the report that ``--out`` writes."""
    commit = subprocess.run(["git", "-C", str(tree), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return {
        "commit": commit.stdout.strip(),
        "limit": limit,
        "caught": sum(result.verdict == "caught" for result in results),
        "of": len(results),
        "faults": [asdict(result) for result in results],
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="print the faults and what a user would notice of them")
    parser.add_argument("--check", action="store_true", help="see that all faults apply, and run no test")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these faults")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="copies at a time (default 1)")
    parser.add_argument("--limit", type=float, default=120.0, metavar="SECONDS", help="of tests a fault (default 120)")
    parser.add_argument("--least", type=int, metavar="N", help=f"faults to be caught for exit code 0 (default {LEAST})")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write a report")
    parser.add_argument("--tree", type=Path, default=TREE, metavar="DIR", help="another checkout to plant them in")
    asked = parser.parse_args(argv)
    known = {fault.name: fault for fault in FAULTS}
    if unknown := [name for name in asked.only or () if name not in known]:
        parser.error(f"--only: no fault is called {', '.join(unknown)}")
    faults = [known[name] for name in asked.only] if asked.only else list(FAULTS)
    tree = asked.tree.resolve()
    if not (tree / "torchpt").is_dir():
        parser.error(f"--tree: {asked.tree} holds no package torchpt")
    if asked.list:
        for fault in faults:
            print(
                f"{fault.name} ({fault.room}, {fault.function})\n    {fault.before}\n -> {fault.after}\n    {fault.why}"
            )
        return 0
    wrong = problems(tree, faults)
    print("\n".join(wrong), file=sys.stderr, end="\n" if wrong else "")
    if asked.check or wrong:
        print(f"{len(faults) - len(wrong)} of {len(faults)} apply")
        return 1 if wrong else 0
    results = run(tree, faults, max(asked.jobs, 1), asked.limit, asked.out)
    caught = sum(result.verdict == "caught" for result in results)
    print(f"caught {caught} of {len(results)}")
    for verdict in ("survived", "time", "broken"):
        if names := [result.name for result in results if result.verdict == verdict]:
            print(f"{verdict}: {', '.join(names)}")
    least = min(LEAST, len(results)) if asked.least is None else asked.least
    return 0 if caught >= least else 1


if __name__ == "__main__":
    sys.exit(main())
