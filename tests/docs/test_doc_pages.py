"""The test of the documentation notices what is wrong with a page."""

import pytest
from doc_pages import Block, Session, assert_printed, parse_only, read_blocks


def block(kind: str, text: str) -> Block:
    return Block("page.md", 1, kind, text, "", ())


@pytest.mark.parametrize(
    "words",
    [["run", "--planer", "idm"], ["no-such-command"], ["convert", "csv"], ["explain"]],
)
def test_a_wrong_command_is_noticed_without_running_it(words: list[str]) -> None:
    with pytest.raises(Exception, match=r"(?i)no such option|no command|missing"):
        parse_only(words)


def test_a_command_that_fails_is_noticed(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssertionError, match="no run folder"):
        Session().do(block("sh", "shiftsim report runs/none\n"))
    with pytest.raises(AssertionError, match=r"page\.md:1"):
        Session().do(block("sh", "false && true\n"))


def test_output_that_is_not_printed_is_noticed() -> None:
    session = Session()
    session.do(block("python", "print('score   0.5 of idm')\n"))
    session.do(block("text", "score 0.5 …\n"))
    with pytest.raises(AssertionError, match=r"not printed: score 0\.6"):
        assert_printed(block("text", "score 0.6\n"), session.printed)


@pytest.mark.parametrize(
    ("text", "problem"),
    [("<!-- skip: x -->\n```sh\nls\n```\n", "unknown"), ("```sh\nls\n", "not closed")],
)
def test_a_block_that_would_be_lost_is_noticed(tmp_path, text: str, problem: str) -> None:
    path = tmp_path / "page.md"
    path.write_text(f"# Page\n\n{text}")
    with pytest.raises(AssertionError, match=problem):
        read_blocks(path)
