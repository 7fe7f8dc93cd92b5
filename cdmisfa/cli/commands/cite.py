"""`cdmisfa cite`: what a paper that uses it cites."""

from __future__ import annotations

from importlib import metadata

import click

from cdmisfa.cli.printing import print_text

BIBTEX = """@software{cdmisfa,
  title = {cdmisfa: record, learn and replay modular slow features},
  author = {{The maintainers of cdmisfa}},
  version = {VERSION},
  license = {Apache-2.0}
}

@article{kompella2017,
  title = {Intrinsically Motivated Acquisition of Modular Slow Features for Humanoids in Continuous
    and Non-Stationary Environments},
  author = {Kompella, Varun Raj and Wiskott, Laurenz},
  journal = {arXiv preprint arXiv:1701.04663},
  year = {2017}
}"""


@click.command("cite")
def cite_command() -> None:
    """Print what a paper that uses it cites, as BibTeX.

    This version, and the paper whose learner it is.
    CITATION.cff of the repository says the same. A run's versions are in its run.json.
    """
    print_text(BIBTEX.replace("VERSION", metadata.version("cdmisfa")))
