"""The report of all studies: one HTML file that shows everything and loads nothing."""

import base64
import re
from html.parser import HTMLParser

import pytest

from warpfrag.studies.report import duration, write_gallery
from warpfrag.studies.runner import StudyRun
from warpfrag.studies.summary import BEGIN, END, Figure, Summary, Table

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)
# Elements without an end tag.
VOID = {"meta", "input", "img", "br", "hr"}
README = f"""# Speckle & <co>

Which multiple? See [the paper](https://example.org/paper), <https://example.org/plain> and [scenes](../../scenes).
Run `a < b`:

```sh
uv run python study.py
```

{BEGIN}
old numbers 12345
{END}

## Meaning
<script>alert(1)</script> ![speckle by depth](figures/shown.png) ![badge](https://example.org/badge.png)
<!-- a remark -->
"""


class Page(HTMLParser):
    """Reads a page: its tags are balanced, and what they refer to is collected."""

    def __init__(self, text):
        super().__init__()
        self.open, self.references, self.images, self.ids, self.tags = [], [], [], [], set()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        """Collect a tag's references."""
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            assert not name.startswith("on")
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href"):
                (self.images if tag == "img" else self.references).append(value)

    def handle_endtag(self, tag):
        """Check that it closes the last one opened."""
        assert self.open.pop() == tag


@pytest.fixture
def run(tmp_path):
    """A study that went well, with a figure its README shows and one it does not."""
    folder = tmp_path / "speckle"
    (folder / "figures").mkdir(parents=True)
    for name in ("shown", "other"):
        (folder / "figures" / f"{name}.png").write_bytes(PNG)
    (folder / "README.md").write_text(README, encoding="utf-8")
    summary = Summary(
        name="speckle",
        title="Speckle & <co>",
        question="Which **multiple** <b>?",
        answer="Twice & more.",
        tables=(
            Table(("depth", "name"), ((1.5, "<i>|"),), caption="By depth."),
            Table(("far",), ((2.5,),), further=True),
        ),
        figures=(Figure("figures/shown.png", "Speckle *by* depth"), Figure("figures/other.png", 'The "other" <one>')),
        command="uv run python study.py",
    )
    return StudyRun(folder, 75.0, summary)


def write(runs, tmp_path):
    """Write a report; return the runs it shows and its text."""
    shown = write_gallery(runs, tmp_path / "report.html")
    return shown, (tmp_path / "report.html").read_text(encoding="utf-8")


def test_report_is_self_contained(run, tmp_path):
    """Tags balance; pictures are inside, once each; links stay within the file; there is no script."""
    _, text = write([run], tmp_path)
    page = Page(text)
    assert page.images == ["data:image/png;base64," + base64.b64encode(PNG).decode()] * 2
    assert page.references == ["#speckle"]
    assert page.ids == ["speckle"]
    assert page.tags.isdisjoint({"script", "link", "iframe", "object"})
    assert not re.search(r"url\(|@import", text)


def test_report_shows_the_study(run, tmp_path):
    """It has the README's text with the new results, the figures with captions, time, versions, and no path."""
    _, text = write([run], tmp_path)
    for part in (
        "<h2>Speckle &amp; &lt;co&gt;</h2>",
        "Which <strong>multiple</strong> &lt;b&gt;?",
        "the paper (https://example.org/paper), https://example.org/plain and scenes.",
        "<code>a &lt; b</code>",
        '<td style="text-align:right">1.5</td>\n<td>&lt;i&gt;|</td>',
        "<h3>Meaning</h3>",
        "&lt;script&gt;alert(1)&lt;/script&gt;",
        '<span class="caption">Speckle <em>by</em> depth</span>',
        '<span class="caption">The &quot;other&quot; &lt;one&gt;</span>',
        "<em>badge</em>",
        "1 min 15 s",
        "numpy ",
        "1 of 1 studies done",
    ):
        assert part in text
    assert "12345" not in text
    assert "a remark" not in text
    assert text.count("uv run python study.py") == 1
    assert str(tmp_path) not in text


def test_further_numbers_are_folded(run, tmp_path):
    """What the README folds, the report folds too."""
    _, text = write([run], tmp_path)
    Page(text)
    inside = text.split("<details>\n<summary>Further numbers</summary>\n")[1].split("</details>")[0]
    assert '<td style="text-align:right">2.5</td>' in inside
    assert "By depth." not in inside
    assert "Meaning" not in inside


def test_command_is_shown_if_the_readme_does_not(run, tmp_path):
    """The command stands below the study."""
    (run.folder / "README.md").write_text(f"Text.\n\n{BEGIN}\n{END}\n", encoding="utf-8")
    _, text = write([run], tmp_path)
    assert "<pre><code>uv run python study.py</code></pre>" in text
    assert "<h2>Speckle &amp; &lt;co&gt;</h2>" in text


def test_failed_study_leaves_the_others(run, tmp_path, monkeypatch):
    """It has a row with its error, without the folders of the machine; the other study is still there."""
    monkeypatch.chdir(tmp_path)
    failed = StudyRun(tmp_path / "broken", 3.0, error=f"ValueError: {tmp_path}/scene.toml: found <3>, expected 4")
    shown, text = write([failed, run], tmp_path)
    Page(text)
    assert shown == [failed, run]
    assert "ValueError: scene.toml: found &lt;3&gt;, expected 4" in text
    assert "1 of 2 studies done" in text
    assert 'id="speckle"' in text
    assert 'id="broken"' not in text


@pytest.mark.parametrize(
    ("lost", "message"), [("README.md", "README.md: got no"), ("figures/shown.png", "no such picture")]
)
def test_study_without_readme_or_picture_has_failed(run, tmp_path, lost, message):
    """What is missing is named in the row, and in the run that is returned."""
    (run.folder / lost).unlink()
    shown, text = write([run], tmp_path)
    assert message in shown[0].error
    assert "0 of 1 studies done" in text
    assert "<section" not in text


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.04, "0.0 s"), (59.4, "59.4 s"), (59.9, "1 min 00 s"), (605, "10 min 05 s")]
)
def test_duration(seconds, words):
    """Seconds below a minute, then minutes and seconds."""
    assert duration(seconds) == words
