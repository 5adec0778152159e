"""The report of all studies: one HTML file with the pictures inside, which loads nothing and opens offline."""

import base64
import mimetypes
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from markdown_it import MarkdownIt

from warpfrag.files.saving import replacing
from warpfrag.studies.runner import StudyRun
from warpfrag.studies.summary import Summary, SummaryError, read_parts
from warpfrag.versions import package_versions

_EXTERNAL = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)
# The only HTML in a README that the report takes over: parts that are folded.
_FOLD = re.compile(r"^(<details>\s*<summary>[^<]*</summary>|</details>)$", re.MULTILINE)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
# Said to the browser too, so that nothing that slips through is loaded.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def write_gallery(runs: Iterable[StudyRun], path: str | os.PathLike) -> list[StudyRun]:
    """Write the report: a table of all studies, then each that did not fail with its README's text and figures.

    Args:
        runs: the studies in the order of the report.
        path: the `.html` file; its folder exists. Folders of this machine are taken out of errors.

    Returns:
        The runs as the report has them: one whose README or pictures are missing has failed.

    Raises:
        OSError: the file cannot be written.
    """
    shown, sections = [], []
    for run in runs:
        if run.summary is not None:
            try:
                sections.append(_section(run.folder, run.summary))
            except (SummaryError, OSError) as error:
                run = replace(run, summary=None, error=str(error))
        shown.append(run)
    seconds, done = sum(run.seconds for run in shown), sum(run.summary is not None for run in shown)
    versions = " · ".join(f"{name} {version}" for name, version in package_versions().items())
    content = [
        "<!doctype html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        "<title>warpfrag: fitting studies</title>",
        f"<style>\n{files('warpfrag.studies').joinpath('report.css').read_text(encoding='utf-8')}</style>",
        "</head>",
        "<body>",
        "<h1>Fitting studies</h1>",
        f'<p class="faint">{done} of {len(shown)} studies done, {duration(seconds)} in all · '
        f"{datetime.now(UTC):%Y-%m-%d} · {escape(versions)}</p>",
        '<div class="scroll overview">',
        "<table>",
        "<thead><tr><th>Study</th><th>Question</th><th>Answer</th><th>Time</th><th>Status</th></tr></thead>",
        "<tbody>",
        *(_row(run) for run in shown),
        "</tbody>",
        "</table>",
        "</div>",
        *sections,
        "</body>",
        "</html>",
    ]
    with replacing(path) as partial:
        partial.write_text("\n".join(content) + "\n", encoding="utf-8")
    return shown


def duration(seconds: float) -> str:
    """Return a time in words, such as `2 min 05 s`."""
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60:02d} s" if whole >= 60 else f"{seconds:.1f} s"


def _row(run: StudyRun) -> str:
    if run.summary is None:
        cells, status = [escape(run.name), "", f'<span class="failed">{escape(_neutral(run.error))}</span>'], "failed"
    else:
        markdown = _markdown(run.folder, run.summary)
        link = f'<a href="#{escape(run.name)}">{escape(run.summary.title)}</a>'
        cells = [link, *(markdown.renderInline(text) for text in (run.summary.question, run.summary.headline))]
        status = "done"
    cells += [duration(run.seconds), f'<span class="{status}">{status}</span>']
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _section(folder: Path, summary: Summary) -> str:
    """Return a study's README as HTML, and below it the figures and the command it does not show."""
    before, _, after = read_parts(folder)
    text = _COMMENT.sub("", f"{before}\n\n{summary.markdown()}\n\n{after}")
    markdown = _markdown(folder, summary)
    shown: dict[str, set[Path]] = {"files": set()}
    # Split by a group, what opens and closes a fold stands at odd places.
    parts = [f"{part}\n" if place % 2 else markdown.render(part, shown) for place, part in enumerate(_FOLD.split(text))]
    for figure in summary.figures:
        if (folder / figure.path).resolve() not in shown["files"]:
            parts.append(_figure(folder / figure.path, figure.caption, markdown.renderInline(figure.caption)))
    if summary.command and summary.command not in text:
        parts.append(f"<pre><code>{escape(summary.command)}</code></pre>\n")
    if not before.lstrip().startswith("# "):
        parts.insert(0, f"<h2>{escape(summary.title)}</h2>\n")
    return f'<section id="{escape(folder.resolve().name)}">\n{"".join(parts)}</section>'


def _markdown(folder: Path, summary: Summary) -> MarkdownIt:
    """Return what turns a study's Markdown into HTML that refers to nothing outside of the file."""
    captions = {(folder / figure.path).resolve(): figure.caption for figure in summary.figures}

    def image(self: Any, tokens: Sequence[Any], place: int, options: Any, env: Any) -> str:
        token = tokens[place]
        source, alt = unquote(str(token.attrs["src"])), self.renderInlineAsText(token.children, options, env)
        if _EXTERNAL.match(source):
            return f"<em>{escape(alt)}</em>"
        path = (folder / source).resolve()
        env.get("files", set()).add(path)
        caption = captions.get(path, alt)
        # Rendered without the environment: a caption's images are not the text's.
        return _figure(folder / source, alt, markdown.renderInline(caption))

    def link_close(self: Any, tokens: Sequence[Any], place: int, options: Any, env: Any) -> str:
        opened = next(token for token in reversed(tokens[:place]) if token.type == "link_open")
        address, text = str(opened.attrs["href"]), tokens[place - 1].content
        return f" ({escape(address)})" if _EXTERNAL.match(address) and address != text else ""

    def heading(self: Any, tokens: Sequence[Any], place: int, options: Any, env: Any) -> str:
        level = min(6, int(tokens[place].tag[1:]) + 1)
        return f"<h{level}>" if tokens[place].nesting == 1 else f"</h{level}>\n"

    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    rules: Mapping[str, Any] = {
        "image": image,
        "link_open": lambda *_: "",
        "link_close": link_close,
        "heading_open": heading,
        "heading_close": heading,
        "table_open": lambda *_: '<div class="scroll">\n<table>\n',
        "table_close": lambda *_: "</table>\n</div>\n",
    }
    for name, rule in rules.items():
        markdown.add_render_rule(name, rule)
    return markdown


def _figure(path: Path, alt: str, caption: str) -> str:
    """Return a picture that fills the window when clicked; in elements that may stand in a paragraph."""
    kind = mimetypes.guess_type(path.name)[0] or ""
    if not path.is_file() or not kind.startswith("image/"):
        raise SummaryError(f"{path}: got no such picture, expected one for the report")
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    picture = f'<img src="data:{kind};base64,{data}" alt="{escape(alt)}">'
    zoom = f'<label><input type="checkbox" aria-label="enlarge">{picture}</label>'
    return f'<span class="figure">{zoom}<span class="caption">{caption}</span></span>\n'


def _neutral(text: str) -> str:
    """Return an error without the folders of this machine."""
    return text.replace(f"{Path.cwd()}{os.sep}", "").replace(str(Path.home()), "~")
