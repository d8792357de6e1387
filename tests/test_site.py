"""The site that MkDocs builds of the documentation needs nothing but itself."""

import os
import pathlib
import re
import subprocess
import sys
import urllib.parse
from html.parser import HTMLParser

import pytest

pytest.importorskip("mkdocs")

ROOT = pathlib.Path(__file__).parent.parent
DOCS = ROOT / "docs"
RESULTS = DOCS / "results"


class Page(HTMLParser):
    """What a page refers to, what can be referred to in it, and what is read."""

    def __init__(self, path):
        super().__init__()
        self.loaded, self.images, self.links = [], [], []
        self.ids, self.text, self._code = set(), "", 0
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.ids.add(values.get("id"))
        self._code += tag in ("code", "pre", "script", "style")
        if tag == "a":
            self.links.append(values.get("href"))
        elif tag == "img":
            self.images.append(values["src"])
        else:
            self.loaded += [values[x] for x in ("href", "src") if x in values]

    def handle_endtag(self, tag):
        self._code -= tag in ("code", "pre", "script", "style")

    def handle_data(self, data):
        if not self._code:
            self.text += data


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(out)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=200
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return out


@pytest.fixture(scope="module")
def pages(site):
    return {path: Page(path) for path in site.rglob("*.html")}


def target(site, path, link):
    """Return the file that a page's link leads to, and the place in it."""
    address = urllib.parse.urlsplit(link)
    if not address.path:
        return path, address.fragment
    below = site if address.path.startswith("/") else path.parent
    found = (below / urllib.parse.unquote(address.path).lstrip("/")).resolve()
    return (found / "index.html" if found.is_dir() else found), address.fragment


def test_all_that_is_public_is_there(site):
    notebook = (site / "examples" / "point_mass" / "index.html").read_text()
    assert "output of the code above" in notebook
    assert "make_train" in (site / "api" / "index.html").read_text()
    assert 'id="gasil_jax.train.make_train"' in (
        (site / "api" / "gasil_jax.train" / "index.html").read_text()
    )


def test_nothing_is_loaded_from_outside(site, pages):
    for path, page in pages.items():
        for link in (*page.loaded, *page.images):
            assert not urllib.parse.urlsplit(link).netloc, (path, link)
            assert target(site, path, link)[0].is_file(), (path, link)
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    assert not re.search(r"@import|url\(\W?(https?:)?//", styles)


def test_links_lead_somewhere(site, pages):
    for path, page in pages.items():
        for link in filter(None, page.links):
            address = urllib.parse.urlsplit(link)
            if address.netloc or address.scheme == "mailto":
                continue
            file, fragment = target(site, path, link)
            assert file.is_file(), (path, link)
            if fragment and file in pages:
                assert fragment in pages[file].ids, (path, link)


def test_a_copied_command_has_no_prompt(site):
    """The button marks the code, and takes what is then visible."""
    rule = ".highlight code[data-md-copying] :is(.gp, .go) {\n  display: none;"
    assert rule in (site / "code.css").read_text()
    page = (site / "running" / "index.html").read_text()
    assert "code.css" in page
    blocks = re.findall(r'<code><span class="gp">.*?</code>', page, re.DOTALL)
    assert len(blocks) == (DOCS / "running.md").read_text().count("```console") > 3
    for block in blocks:
        hidden = re.sub(r'<span class="g[po]">.*?</span>', "", block)
        text = re.sub(r"<[^>]*>", "", hidden)
        assert re.search(r"^python -m gasil_jax", text, re.MULTILINE)
        assert not re.search(r"^\$", text, re.MULTILINE), text


def test_formulas_are_rendered(site, pages):
    for path, page in pages.items():
        found = re.search(r"\\[(\[]|\\[a-z]{2,}|\$\$", page.text)
        assert not found, (path, page.text[found.start() :][:80])
    assert (site / "algorithm" / "index.html").read_text().count("<math") > 30


def test_every_page_and_picture_can_be_reached(site, pages):
    """The navigation leads to all pages, and the pages show all pictures."""
    home = site / "index.html"
    listed = {target(site, home, link)[0] for link in pages[home].links if link}
    for path in (*DOCS.glob("*.md"), *RESULTS.glob("*.md")):
        folder = site / "results" if path.parent == RESULTS else site
        name = "" if path.stem in ("index", "README") else path.stem
        assert folder / name / "index.html" in listed, path
    shown = {
        target(site, path, link)[0] for path in pages for link in pages[path].images
    }
    pictures = [*RESULTS.glob("*.png"), *DOCS.glob("*.gif")]
    assert {path.name for path in pictures} <= {path.name for path in shown}
    # The home page shows a film and a figure.
    assert len(pages[home].images) >= 2
