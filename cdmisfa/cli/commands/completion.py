"""`cdmisfa completion`: what a shell needs to complete commands."""

from __future__ import annotations

import click

from cdmisfa.cli import completing
from cdmisfa.cli.printing import print_text


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion_command(ctx: click.Context, shell: str) -> None:
    """Print what a shell needs to complete commands, scenes, presets, keys and runs.

    In ~/.bashrc, or with zsh in ~/.zshrc: eval "$(cdmisfa completion bash)". Of fish write it to
    ~/.config/fish/completions/cdmisfa.fish.
    """
    print_text(completing.script(ctx.find_root().command, shell))
