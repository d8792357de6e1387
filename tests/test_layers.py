"""The direction of imports: cli -> host -> files -> algorithm -> errors."""

import ast
import pathlib
import re

import pytest

from gasil_jax.__main__ import COMMANDS

ROOT = pathlib.Path(__file__).parent.parent
#: What reads files, or policies from them; the algorithm does without, but for the
#: agent that reads an expert's trajectories.
FILES = {"npz", "numpy_policy", "policy", "evaluation", "presets", "agents.expert"}
READS_AN_EXPERT = ("agents.adversarial", "agents.expert")
#: What modules of each layer may import of the package. The doors are those that
#: `python -m` starts; "algorithm" is every module that is in no other layer.
ALLOWED = {
    "errors": set(),
    "algorithm": {"errors", "algorithm"},
    "files": {"errors", "algorithm", "files"},
    "host": {"errors", "algorithm", "files", "host"},
    "cli": {"errors", "algorithm", "files", "host", "cli"},
    "doors": {"cli", "errors"},
}


def layer(module):
    """Return the layer of a module, given its name below the package."""
    if module in FILES:
        return "files"
    top = module.split(".")[0]
    if top in (*COMMANDS, "__main__"):
        return "doors"
    return top if top in ALLOWED else "algorithm"


def imports(path):
    """Yield the names of all modules that a file imports anywhere.

    A string that is nothing but a name counts, since `importlib` may import it.
    """
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path} has a relative import"
            for alias in node.names:
                yield f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if re.fullmatch(r"\w+(\.\w+)+", node.value):
                yield node.value


def modules(package):
    """Yield the name and path of every module of a package, except the package."""
    for path in sorted(package.rglob("*.py")):
        name = ".".join(path.relative_to(package).with_suffix("").parts)
        if name != "__init__":
            yield name.removesuffix(".__init__"), path


def packages(module):
    """Return the packages that hold a module, which Python imports before it."""
    parts = module.split(".")
    return {".".join(parts[:count]) for count in range(1, len(parts))}


def edges():
    """Yield (importing module, imported module) for modules below gasil_jax."""
    package = ROOT / "gasil_jax"
    names = {name for name, _ in modules(package)}
    for name, path in modules(package):
        for imported in imports(path):
            # The package's public names are of every layer; it has a version, too.
            if name != "__main__":
                assert imported != "gasil_jax", f"{name} imports the whole package"
            below = imported.removeprefix("gasil_jax.")
            # A command names itself in its messages.
            if below in (imported, name.removeprefix("cli.")):
                continue
            # `from gasil_jax.host import driver`, or a name of such a module.
            if below not in names:
                below = below.rpartition(".")[0]
            assert below in names, f"{name} imports {imported}: name its module"
            yield name, below
            yield from ((name, x) for x in packages(below) - packages(name) - {name})


def test_imports_point_one_way():
    wrong = [
        f"{name} ({layer(name)}) imports {imported} ({layer(imported)})"
        for name, imported in edges()
        if layer(imported) not in ALLOWED[layer(name)]
        and (name, imported) != READS_AN_EXPERT
    ]
    assert not wrong


def test_the_algorithm_reads_no_files():
    for name, path in modules(ROOT / "gasil_jax"):
        if layer(name) in ("errors", "algorithm"):
            tops = {imported.split(".")[0] for imported in imports(path)}
            assert not tops & {"csv", "io", "json", "os", "pathlib", "shutil"}, name


def test_no_module_imports_itself_by_way_of_others():
    graph = {}
    for name, imported in edges():
        graph.setdefault(name, set()).add(imported)
    finished, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path, name])
        if name in finished:
            return
        path.append(name)
        for imported in graph.get(name, ()):
            visit(imported)
        finished.add(path.pop())

    for name in list(graph):
        visit(name)


@pytest.mark.parametrize("package", ["gasil_jax", "envs/gasil_envs", "docs/examples"])
def test_a_package_does_not_import_what_is_built_on_it(package):
    for path in (ROOT / package).rglob("*.py"):
        for imported in imports(path):
            forbidden = ("experiments",)
            if package == "envs/gasil_envs":
                forbidden += ("gasil_jax",)
            assert imported.split(".")[0] not in forbidden, path


def test_every_layer_has_modules():
    assert {layer(name) for name, _ in modules(ROOT / "gasil_jax")} == set(ALLOWED)
