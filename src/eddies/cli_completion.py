"""Scripts with which a shell completes command lines of eddies: made from the parser itself, so that they know what it
knows."""

import argparse
from collections.abc import Iterable, Iterator

from eddies.cli_options import build_parser
from eddies.scene.comparison import BUILT_IN as COMPARISONS
from eddies.scene.scene import builtin_scenes

BASH = """\
_eddies() {{
    local words= options= word=${{COMP_WORDS[COMP_CWORD]}}
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{commands}"
    else
        case "${{COMP_WORDS[1]}} ${{COMP_WORDS[COMP_CWORD-1]}}" in
{cases}
        esac
        case "$word" in -*) words=$options;; esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _eddies eddies
"""


def completion(shell: str) -> str:
    """The script for "bash", "zsh" or "fish": commands, options, their values where these are few, and the names of
    built-in scenes and comparisons; else names of files, as the shell has them."""
    if shell == "fish":
        return "".join(f"{line}\n" for line in _fish())
    zsh = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return zsh + _bash()


def _commands() -> dict[str, argparse.ArgumentParser]:
    """The parsers of all commands by name."""
    return next(dict(action.choices) for action in build_parser()._actions
                if isinstance(action, argparse._SubParsersAction))


def _options(command: argparse.ArgumentParser) -> list[argparse.Action]:
    """The options that the help of a command names."""
    return [action for action in command._actions if action.option_strings and action.help is not argparse.SUPPRESS]


def _names(command: argparse.ArgumentParser) -> list[str]:
    """What may stand in a command line of a command without an option before it, as far as it is known."""
    known = {"SCENE": [name for name, _ in builtin_scenes()],
             "COMPARISON": sorted(path.stem for path in COMPARISONS.glob("*.toml"))}
    return [name for action in command._actions if not action.option_strings
            for name in action.choices or known.get(str(action.metavar), ())]


def _takes_value(action: argparse.Action) -> bool:
    return action.nargs != 0


def _bash() -> str:
    """A case for each kind of last word: an option with any value, one with few, and else what the command takes."""
    free: dict[str, bool] = {}
    values: list[str] = []
    commands: dict[tuple[str, str], list[str]] = {}
    for name, command in _commands().items():
        options = _options(command)
        for option in filter(_takes_value, options):
            for text in option.option_strings:
                if option.choices:
                    values.append(_case([f'"{name} {text}"'], " ".join(option.choices)))
                else:
                    free[f'*" {text}"'] = True
        texts = " ".join(text for option in options for text in option.option_strings)
        commands.setdefault((" ".join(_names(command)), texts), []).append(f'"{name} "*')
    cases = [_case(free, ""), *values, *(_case(patterns, *given) for given, patterns in commands.items())]
    return BASH.format(commands=" ".join(_commands()), cases="\n".join(cases))


def _case(patterns: Iterable[str], words: str, options: str = "") -> str:
    return f'            {"|".join(patterns)}) words="{words}" options="{options}";;'


def _fish() -> Iterator[str]:
    """A line for each command, option and name. What is not known is a file."""
    for name, command in _commands().items():
        yield f"complete -c eddies -f -n __fish_use_subcommand -a {name} -d {_quoted(command.description)}"
        only = f"complete -c eddies -n '__fish_seen_subcommand_from {name}'"
        for option in _options(command):
            text = " ".join(f"-{'l' if word.startswith('--') else 's'} {word.lstrip('-')}"
                            for word in option.option_strings)
            takes = (f" -x -a '{' '.join(option.choices)}'" if option.choices else " -r") * _takes_value(option)
            yield f"{only} {text}{takes} -d {_quoted(option.help)}"
        if names := _names(command):
            yield f"{only} -a '{' '.join(names)}'"


def _quoted(text: str | None) -> str:
    """A text as one word of a command line of fish."""
    return "'" + (text or "").replace("\\", "\\\\").replace("'", "\\'").replace("%%", "%") + "'"
