"""`mill completion`."""

import pytest
from mill_command import mill


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_each_shell_is_printed(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("completion", shell) == 0
    said = capsys.readouterr()
    assert f"_MILL_COMPLETE={shell}_complete" in said.out
    assert said.err == ""


def test_another_shell_is_one_line_that_names_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("completion", "tcsh") == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    for part in ("SHELL", "tcsh", "bash", "zsh", "fish", "mill completion --help"):
        assert part in said.err


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("mill ev", {"evaluate"}),
        ("mill runs s", {"show"}),
        ("mill evaluate l", {"landmarks"}),
        ("mill jog --ho", {"--home"}),
    ],
)
def test_what_the_script_asks_for_is_answered(
    typed: str, offered: set[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in (
        ("_MILL_COMPLETE", "bash_complete"),
        ("COMP_WORDS", typed),
        ("COMP_CWORD", str(typed.count(" "))),
    ):
        monkeypatch.setenv(name, value)
    assert mill() == 0
    assert {line.split(",")[1] for line in capsys.readouterr().out.splitlines()} == offered
