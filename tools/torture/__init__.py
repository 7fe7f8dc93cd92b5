"""Campaigns against the project: kills, damage, full disks, races, each case from its seed.

    python -m tools.torture [CAMPAIGN ...] [--minutes 60] --seed 0 --jobs 2 -o build/torture

Each campaign ends when it has had as many cases as it states. A run that was stopped is gone on
with by the same command at the same commit. One case again, with its folder kept:

    python -m tools.torture CAMPAIGN --case SEED

To add a campaign, write a module here and put its name into `CAMPAIGNS` (campaigns.py). It has

    case(job: Job) -> Outcome     one case; raises `Defect` for what must not happen
    prepare(folder: Path) -> Any  (optional) what all of its cases share, made once: `job.given`
    LIMITS = Limits(...)          of one case: seconds, megabytes; of all: how many are enough

Each case runs in a forked process of its own, in a new session and an empty folder, with
everything that `prepare` imported already there; what it leaves running is killed. Everything
random comes from `job.rng`; a campaign that goes through a list takes `job.seed` modulo its length,
and where `prepare` gave the list it ends when each was taken once.
Groups (`Outcome.group`) are counted apart in the data beside the page.
"""
