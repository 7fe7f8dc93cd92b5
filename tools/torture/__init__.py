"""Campaigns against the commands: kill them, damage their files, let system calls fail.

    python -m tools.torture [CAMPAIGN ...] [--minutes 10] [--seed 0] [--jobs 2]
    python -m tools.torture CAMPAIGN --case SEED     run one case again and keep its folder

A campaign is a module of this package with

    case(job: Job) -> str           run one case; return RIGHT, REFUSED or SKIPPED, raise `Defect`
    prepare(folder: Path) -> Any    make what all cases share, once: `job.shared`
    MEGABYTES, BESIDE               (optional) memory limit; cases at a time for each job

Each case runs in a forked process in a new session, in an empty folder; processes that it leaves
are killed. Everything random comes from `job.rng`, which the seed determines.
"""
