"""The site: its navigation lists every page, its API page every public name."""

import ast
import inspect
import re
from pathlib import Path

import pytest
import yaml

from rmp_mjx.rmp.leaves import Barrier

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


def exports(package: str) -> list[str]:
    """Public names that a package's `__init__.py` re-exports or defines."""
    facade = ROOT / package / "facade.py"  # where names are loaded on demand
    file = facade if facade.exists() else ROOT / package / "__init__.py"
    tree = ast.parse(file.read_text())
    found = []
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            found += [a.asname for a in node.names if a.asname == a.name]
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.append(node.name)
        elif isinstance(node, ast.AnnAssign):
            found.append(ast.unparse(node.target))
    return [name for name in found if name and not name.startswith("_")]


def leaves(nav: list | dict | str) -> list[str]:
    """The files of a navigation tree."""
    if isinstance(nav, str):
        return [nav]
    children = nav.values() if isinstance(nav, dict) else nav
    return [file for child in children for file in leaves(child)]


@pytest.mark.parametrize("package", ["rmp_mjx", "envs", "rmp_mjx/deploy"])
def test_the_api_page_documents_every_public_name(package):
    documented = re.findall(r"^::: (\S+)", (DOCS / "api.md").read_text(), re.M)
    names = exports(package)
    assert len(names) > 3
    path = package.replace("/", ".")
    missing = [name for name in names if f"{path}.{name}" not in documented]
    assert not missing


def test_the_controllers_come_first_on_the_api_page():
    documented = re.findall(r"^::: (\S+)", (DOCS / "api.md").read_text(), re.M)
    assert documented[:2] == ["rmp_mjx.RMPVICES", "rmp_mjx.VICES"]


def test_the_navigation_lists_every_page_once():
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    listed = leaves(config["nav"])
    pages = {p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md")}
    assert sorted(listed) == sorted(pages)


def test_the_maths_page_and_the_barriers_docstring_have_one_formula():
    """tests/rmp checks the code against the docstring."""
    blocks = re.findall(r"^\$\$\n.*?^\$\$", inspect.getdoc(Barrier) or "", re.M | re.S)
    assert len(blocks) == 1
    assert blocks[0] in (DOCS / "maths.md").read_text()


def test_the_pages_name_tests_that_exist():
    """A page may name a test file by its name alone or by its path."""
    tests = {p.relative_to(ROOT).as_posix() for p in ROOT.glob("tests/**/test_*.py")}
    names = {path.rpartition("/")[2] for path in tests}
    text = "".join(page.read_text() for page in DOCS.glob("*.md"))
    named = set(re.findall(r"(?:[\w/]+/)?test_\w+\.py", text))
    assert len(named) > 10
    assert not [n for n in named if n not in names and n not in tests]


@pytest.mark.parametrize(
    "page", ["README.md", "CONTRIBUTING.md", "benchmarks/README.md"]
)
def test_links_outside_the_site_lead_to_files(page):
    """`mkdocs build --strict` checks those inside."""
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", (ROOT / page).read_text())
    assert links
    assert not [
        link for link in links if not (ROOT / page).parent.joinpath(link).exists()
    ]
