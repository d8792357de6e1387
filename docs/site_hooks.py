"""What MkDocs does beside its plugins: formulas, notebooks, the search."""

import base64
import html
import json
import logging
import pathlib
import re
from typing import Any

from latex2mathml import converter
from mkdocs.structure.files import File

_LOG = logging.getLogger("mkdocs.hooks.site")
#: What pymdownx.arithmatex makes of a formula.
_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL
)
#: A module in api.md, with the options that choose its names.
_MODULE = re.compile(r"^::: (\S+)\n((?:    .*\n)*)", re.MULTILINE)
#: A picture and where it is.
_PICTURE = re.compile(r'(<img [^>]*src="([^"]*)"[^>]*>)')
#: TeX's spaces that the converter leaves out: around a function's name, and none behind
#: a minus that is a sign.
_SPACES = (
    (r"(?<=</mi>)(?=<mi>(?:log|tanh)</mi>)", '<mspace width="0.167em" />'),
    (r"(<mi>(?:log|tanh)</mi>)(?=<mi>)", r'\1<mspace width="0.167em" />'),
    (r"(<mo[^>]*>[=(,\[]</mo>)<mo>−</mo>", r'\1<mo form="prefix">−</mo>'),
)


def _mathml(match: re.Match[str]) -> str:
    display = "block" if match[2] == "[" else "inline"
    tex = html.unescape(match[3])
    written = re.sub(
        r"&#x(\w+);",
        lambda code: html.escape(chr(int(code[1], 16))),
        converter.convert(tex, display=display),
    )
    for pattern, replacement in _SPACES:
        written = re.sub(pattern, replacement, written)
    return written


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let the search prefer the guide to results, which have the same words.

    The page of the API links the pages of its modules.
    """
    section = page.file.src_uri.partition("/")[0]
    boost = {"results": 0.3, "reproducing.md": 0.3, "api": 0.6}.get(section, 2.0)
    page.meta.setdefault("search", {"boost": boost})
    return _MODULE.sub(_link, markdown) if section == "api.md" else markdown


def _link(module: re.Match[str]) -> str:
    names = re.search(r"members: \[(.*)\]", module[2])
    more = f": {names[1]}" if names else ""
    return f"- [`{module[1]}`](api/{module[1]}.md){more}\n"


def on_page_content(content: str, page: Any, **_: Any) -> str:
    """Turn a page's TeX into MathML, and link each picture to its file.

    Browsers draw MathML without a script. Many panels can be read in full size only.
    """
    content = _FORMULA.sub(_mathml, content)
    content = _PICTURE.sub(r'<a href="\2">\1</a>', content)
    for formula in re.findall(r"<math.*?</math>", content, re.DOTALL):
        if "\\" in formula:  # as the converter writes what it does not know
            _LOG.warning("%s: a formula that is not known: %s", page.url, formula)
    return content


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Make a page of each module of the API, and of each notebook.

    A notebook's page has what its code has printed and drawn.
    """
    docs = pathlib.Path(config.docs_dir)
    for module in _MODULE.finditer((docs / "api.md").read_text()):
        uri, content = f"api/{module[1]}.md", f"# {module[1]}\n\n{module[0]}"
        files.append(File.generated(config, uri, content=content))
    for path in docs.glob("examples/*.ipynb"):
        parts = []
        for cell in json.loads(path.read_text())["cells"]:
            text = "".join(cell["source"])
            is_code = cell["cell_type"] == "code"
            parts.append(f"```python\n{text}\n```" if is_code else text)
            for output in cell.get("outputs", ()):
                if "text" in output:
                    parts.append(f"```text\n{''.join(output['text'])}```")
                else:
                    name = f"{path.stem}-{len(parts)}.png"
                    picture = base64.b64decode(output["data"]["image/png"])
                    uri = (path.parent / name).relative_to(docs).as_posix()
                    files.append(File.generated(config, uri, content=picture))
                    parts.append(f"![output of the code above]({name})")
        page = path.relative_to(docs).with_suffix(".md").as_posix()
        files.append(File.generated(config, page, content="\n\n".join(parts)))
    return files
