"""What a study has found: written to its README and read back, whole or not at all."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from warpfrag.studies.summary import BEGIN, END, Figure, Summary, SummaryError, Table

README = f"# Title\n\nBefore.\n\n{BEGIN}\nold\n{END}\n\nAfter.\n"
SUMMARY = Summary(
    name="speckle",
    title="Speckle",
    question="How much?",
    answer="Twice 1.5 is enough.",
    tables=(Table(("depth", "multiple", "note"), ((1, 1.5, "a|b"), (10, 0.123456789, "–")), caption="By depth."),),
    figures=(Figure("figures/speckle.png", "Speckle by depth"),),
    numbers={"z": np.float32(1.0) / 3.0, "a": np.int64(7)},
    command="uv run python study.py",
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A study's folder with a README and a figure; the working folder is the one above."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "speckle" / "figures").mkdir(parents=True)
    (tmp_path / "speckle" / "README.md").write_text(README, encoding="utf-8")
    (tmp_path / "speckle" / "figures" / "speckle.png").write_bytes(b"png")
    return tmp_path / "speckle"


def contents(folder):
    """Return every file below a folder, by name."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_table_aligns_numbers():
    """Columns of numbers stand to the right, text to the left; a bar stays in its cell."""
    assert SUMMARY.tables[0].markdown().splitlines() == [
        "By depth.",
        "",
        "| depth | multiple | note |",
        "| ----: | -------: | ---- |",
        "|     1 |      1.5 | a\\|b |",
        "|    10 | 0.123457 | –    |",
    ]


@pytest.mark.parametrize(
    ("cells", "right"),
    [
        ((1, 2.5), True),
        (("98 %", "<1e-06", "–"), True),
        (("2P", "−3 dB"), True),
        (("3 spheres", 4), False),
        (("–", ""), False),
    ],
)
def test_column_of_numbers(cells, right):
    """A column is one of numbers if all that is not empty is a number, perhaps with a short unit."""
    rule = Table(("c",), tuple((cell,) for cell in cells)).markdown().splitlines()[1]
    assert rule.endswith(": |") == right


def test_further_tables_are_folded():
    """The answer and the main tables are read at once; the others stand after them, in one part that opens."""
    further = (Table(("b",), ((2,),), caption="More.", further=True), Table(("c",), ((3,),), further=True))
    text = replace(SUMMARY, tables=(further[0], *SUMMARY.tables, further[1])).markdown()
    before, rest = text.split("<details>\n<summary>Further numbers</summary>\n\n")
    assert before == f"{SUMMARY.markdown()}\n\n"
    assert rest == "\n\n".join([*(table.markdown() for table in further), "</details>"])


def test_save_rewrites_the_marked_part(folder):
    """What stands around the markers stays, saving again changes nothing, and numbers.json is sorted and rounded."""
    SUMMARY.save(folder)
    text = (folder / "README.md").read_text(encoding="utf-8")
    assert text == f"# Title\n\nBefore.\n\n{BEGIN}\n\n{SUMMARY.markdown()}\n\n{END}\n\nAfter.\n"
    assert (folder / "numbers.json").read_text() == '{\n  "a": 7,\n  "z": 0.333333\n}\n'
    before = contents(folder.parent)
    SUMMARY.save(folder)
    assert contents(folder.parent) == before


def test_headline_is_the_first_paragraph():
    """What stands in overviews; the README has all of it."""
    summary = replace(SUMMARY, answer="Twice 1.5.\n\nMore of it.")
    assert summary.headline == "Twice 1.5."
    assert "More of it." in summary.markdown()


def test_load_returns_what_was_saved(folder):
    """The file is results/fit/<name>/summary.json, or in another folder of results."""
    SUMMARY.save(folder)
    assert Summary.load(Path("results") / "fit" / "speckle" / "summary.json") == SUMMARY
    SUMMARY.save(folder, results=folder.parent / "other")
    assert Summary.load(folder.parent / "other" / "speckle" / "summary.json") == SUMMARY


@pytest.mark.parametrize(
    ("readme", "message"),
    [
        (None, "README.md: got no file"),
        (b"text", "0 times, expected it once"),
        (f"{BEGIN} {BEGIN} {END}".encode(), "2 times"),
        (f"{END} {BEGIN}".encode(), "expected it after"),
        (b"\xff\xfe", "not UTF-8"),
    ],
)
def test_save_needs_a_readme_with_markers(folder, readme, message):
    """One line says what is wrong, and nothing is written."""
    (folder / "README.md").unlink()
    if readme is not None:
        (folder / "README.md").write_bytes(readme)
    before = contents(folder.parent)
    with pytest.raises(SummaryError, match=message) as caught:
        SUMMARY.save(folder)
    assert "\n" not in str(caught.value)
    assert contents(folder.parent) == before


def test_save_needs_its_figures(folder):
    """A figure that was not drawn is named, and nothing is written."""
    (folder / "figures" / "speckle.png").unlink()
    before = contents(folder.parent)
    with pytest.raises(SummaryError, match=r"speckle.png: got no such file"):
        SUMMARY.save(folder)
    assert contents(folder.parent) == before


def test_save_writes_all_or_nothing(folder, monkeypatch):
    """When one of the files cannot be written, the others stay as they were."""
    before = contents(folder.parent)
    write, written = Path.write_text, []

    def write_two(path, text, **options):
        if len(written) == 2:
            raise OSError("disk full")
        written.append(path)
        return write(path, text, **options)

    monkeypatch.setattr(Path, "write_text", write_two)
    with pytest.raises(OSError, match="disk full"):
        SUMMARY.save(folder)
    assert contents(folder.parent) == before


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Summary("a/b", "", "", ""), "name: got 'a/b'"),
        (lambda: Summary("a", "", "", "", numbers={"error": float("nan")}), "error: got nan, expected a finite"),
        (lambda: Summary("a", "", "", "", numbers={"error": "1"}), "error: got '1', expected a number"),
        (lambda: Table(("a", "b"), (("x", 1), ("y",))), "got 1 cells in row 2, expected 2"),
        (lambda: Table(("a",), ((float("inf"),),)), "got inf"),
    ],
)
def test_refuses_what_cannot_be_written(make, message):
    """Names that are no folder's, and numbers that are none, get one line."""
    with pytest.raises(SummaryError, match=message):
        make()


@pytest.mark.parametrize("content", [None, b"", b"[]", b'{"name": "a"}', b'{"name": "", "title": 3}'])
def test_load_refuses_what_is_no_summary(tmp_path, content):
    """A missing, damaged or foreign file gets one line that names it."""
    path = tmp_path / "summary.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SummaryError, match=r"summary.json: got no"):
        Summary.load(path)
