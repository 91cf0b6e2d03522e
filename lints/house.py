"""The house rules that no linter of the shelf keeps: names, lengths, circles, hidden imports and plain words."""

import ast
import re
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "terrella"
MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_PARAMETERS = 450, 60, 8

# Rooms that may import first-party code inside a function, so that `terrella --help` starts at once.
LAZY = ("library.py", "cli/", "workflows/")

# Optional packages: the leaf file named after one may be imported inside a function, for the package may be absent.
OPTIONAL = {
    "ale_py", "foxglove", "h5py", "mcap", "mujoco", "mujoco_warp", "onnxruntime", "pycolmap", "ray", "rerun", "skimage",
    "stable_baselines3", "vizdoom", "warp",
}  # fmt: skip

# Numba kernels and autograd functions take plain arrays: their parameter lists may be long.
LONG_SIGNATURES = ("kernels_numba", "space/raster/rasterise.py")

# Public classes that share a name on purpose, with the reason.
SHARED_NAMES: dict[str, str] = {}

# Words of a private English, in names and in text. docs/style.md says what to write instead.
PRIVATE_WORDS = re.compile(
    r"(?<![a-z])(told|foretell\w*|foretold|heed\w*|steadied|for who|is said of|was paid|so many|worth)(?![a-z])",
    re.IGNORECASE,
)

PRIVATE_NAMES = {"found", "told", "said", "there", "worth", "sound", "moved", "asked"}


def sources() -> dict[str, ast.Module]:
    """Every module of the package: its dotted name and its tree."""
    modules = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        modules[name] = ast.parse(path.read_text(), str(path.relative_to(ROOT)))
        modules[name].path = path.relative_to(PACKAGE).as_posix()  # type: ignore[attr-defined]
    return modules


def shared_class_names(modules: dict[str, ast.Module]) -> list[str]:
    """Public classes of one name in two files."""
    places = defaultdict(list)
    for tree in modules.values():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(f"{tree.path}:{node.lineno}")
    return [
        f"class {name} means {len(at)} things: {', '.join(at)}"
        for name, at in sorted(places.items())
        if len(at) > 1 and name not in SHARED_NAMES
    ]


def lengths(modules: dict[str, ast.Module]) -> list[str]:
    """Files, functions and parameter lists that are too long."""
    wrong = []
    for tree in modules.values():
        lines = len((PACKAGE / tree.path).read_text().splitlines())
        if lines > MAX_FILE_LINES:
            wrong.append(f"{tree.path} has {lines} lines, more than {MAX_FILE_LINES}")
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            where = f"{tree.path}:{node.lineno} {node.name}"
            if (long := node.end_lineno - node.lineno + 1) > MAX_FUNCTION_LINES:
                wrong.append(f"{where} has {long} lines, more than {MAX_FUNCTION_LINES}")
            names = [a.arg for a in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]]
            count = len([n for n in names if n not in ("self", "cls")])
            if count > MAX_PARAMETERS and not any(part in tree.path for part in LONG_SIGNATURES):
                wrong.append(f"{where} has {count} parameters, more than {MAX_PARAMETERS}")
    return wrong


def imported(module: str, tree: ast.Module, node: ast.AST, known: set[str]) -> list[str]:
    """The first-party modules that one import statement names."""
    if isinstance(node, ast.Import):
        return [a.name for a in node.names if a.name in known]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = node.module or ""
    if node.level:
        package = module if tree.path.endswith("__init__.py") else module.rpartition(".")[0]
        for _ in range(node.level - 1):
            package = package.rpartition(".")[0]
        base = f"{package}.{base}" if base else package
    found = [f"{base}.{a.name}" if f"{base}.{a.name}" in known else base for a in node.names]
    return [m for m in found if m in known]


def circles(modules: dict[str, ast.Module]) -> list[str]:
    """Files that import each other in a circle, counting imports for type checking and inside functions."""
    known = set(modules)
    arrows = {
        m: {t for node in ast.walk(tree) for t in imported(m, tree, node, known)} - {m} for m, tree in modules.items()
    }
    index, low, stack, wrong = {}, {}, [], []

    def visit(m: str) -> None:  # Tarjan's strongly connected components
        index[m] = low[m] = len(index)
        stack.append(m)
        for t in sorted(arrows[m]):
            if t not in index:
                visit(t)
            if t in stack:
                low[m] = min(low[m], low[t])
        if low[m] == index[m]:
            part = stack[stack.index(m) :]
            del stack[stack.index(m) :]
            if len(part) > 1:
                wrong.append(f"a circle of files: {', '.join(sorted(part))}")

    sys.setrecursionlimit(10_000)
    for m in modules:
        if m not in index:
            visit(m)
    return wrong


def hidden_imports(modules: dict[str, ast.Module]) -> list[str]:
    """First-party imports inside a function, but for the rooms that start lazily."""
    known, optional, wrong = set(modules), optional_modules(modules), []
    for m, tree in modules.items():
        if tree.path.startswith(LAZY):
            continue
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                for node in ast.walk(function):
                    names = [n for n in imported(m, tree, node, known) if n not in optional]
                    if names:
                        wrong.append(f"{tree.path}:{node.lineno} imports {', '.join(names)} inside {function.name}")
    return wrong


def optional_modules(modules: dict[str, ast.Module]) -> set[str]:
    """The modules that cannot be imported without an optional package, directly or through another module."""
    known, optional, arrows = set(modules), set(), {}
    for m, tree in modules.items():
        nodes = [n for top in tree.body for n in (top.body if isinstance(top, ast.Try) else [top])]
        names = {a.name for n in nodes if isinstance(n, ast.Import) for a in n.names}
        names |= {n.module or "" for n in nodes if isinstance(n, ast.ImportFrom) and not n.level}
        arrows[m] = {t for n in nodes for t in imported(m, tree, n, known)}
        if any(name.split(".")[0] in OPTIONAL for name in names):
            optional.add(m)
    while more := {m for m, targets in arrows.items() if targets & optional} - optional:
        optional |= more
    return optional


def private_names(modules: dict[str, ast.Module]) -> list[str]:
    """Variables, parameters, attributes and functions whose whole name is a word of a private English."""
    wrong = []
    for tree in modules.values():
        for node in ast.walk(tree):
            name = getattr(node, "name", None) or getattr(node, "arg", None)
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                name = node.id
            if name in PRIVATE_NAMES:
                wrong.append(f"{tree.path}:{node.lineno} names something {name!r}")
    return wrong


def private_words() -> list[str]:
    """Words that a reader of the field must read twice, in code, guides and the page."""
    files = [*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.js"), *PACKAGE.rglob("*.html"), *(ROOT / "docs").glob("*.md")]
    wrong = []
    for path in sorted([*files, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]):
        if path.name == "style.md":
            continue
        for number, line in enumerate(path.read_text().splitlines(), 1):
            for word in PRIVATE_WORDS.findall(line):
                wrong.append(f"{path.relative_to(ROOT)}:{number} says {word!r}")
    return wrong


def main() -> int:
    modules = sources()
    wrong = [
        *shared_class_names(modules),
        *lengths(modules),
        *circles(modules),
        *hidden_imports(modules),
        *private_names(modules),
        *private_words(),
    ]
    print("\n".join(wrong) if wrong else "the house rules hold")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
