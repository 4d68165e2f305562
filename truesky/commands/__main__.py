"""truesky COMMAND ...: every command is a job or a module of truesky, with the options that it has itself.

    truesky run REQUEST --lake LAKE         all that a request needs, then a table and pictures
    truesky check REQUEST                   whether a request is valid and all of it can be rendered
    truesky build | fluxes | lenses | gaia | plan | render  --lake LAKE --request REQUEST
                                            one job: catalogues, fluxes, strong lenses, Gaia's view, plan, images
    truesky page LAKE                       the lake in the browser, and a TAP service for other tools
    truesky sql QUERY --lake LAKE           a SELECT over the lake's tables
    truesky list | verify | gc | describe LAKE      what is there, whether it is whole, what no longer serves
    truesky push LAKE s3://BUCKET/PREFIX    puts a lake on object storage, from where it can be read
    truesky masters | reduce | stack        master frames, calibrated images and their sources, stacks of dithers
    truesky report LAKE                     what the runs took, beside the forecast
    truesky validate --lake LAKE            what the lake holds against what it should, a table and a report
    truesky mission ...                     the mission database
    truesky examples FOLDER                 copies requests and notebooks

Jobs run under spark-submit; what follows a -- goes to it (truesky render ... -- --master spark://HEAD:7077), and
`truesky --local COMMAND ...` runs them in this Python's own session.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NoReturn

from lake_schema import __version__, command
from truesky.commands import submit

# Command -> the modules of its jobs, one after another.
JOBS = {
    "build": ("truesky.catalogue.build_galaxies", "truesky.catalogue.build_stars"),
    "fluxes": ("truesky.fluxes.compute_fluxes",),
    "lenses": ("truesky.catalogue.build_strong_lenses",),
    "gaia": ("truesky.catalogue.build_gaia",),
    "plan": ("truesky.commands.plan",),
    "render": ("truesky.render.render_exposures",),
}
# Command -> the module whose `main` it is, and whether that module wants the command's word, too.
MODULES = {
    "check": ("truesky.commands.check", False),
    "sql": ("truesky.explore.__main__", False),
    "list": ("lake_schema.__main__", True),
    "verify": ("lake_schema.__main__", True),
    "gc": ("lake_schema.__main__", True),
    "describe": ("lake_schema.__main__", True),
    "mission": ("lake_schema.__main__", True),
    "push": ("lake_schema.store.object_storage.push", False),
    "masters": ("truesky.reduction.masters", False),
    "reduce": ("truesky.reduction.reduce", False),
    "stack": ("truesky.reduction.stack", False),
    "report": ("truesky.commands.report", False),
    "validate": ("truesky.validation.__main__", False),
    "page": ("truesky.page.__main__", False),
    "examples": ("truesky.commands.examples", False),
}
# Command -> the extra of the package that it requires.
EXTRAS = {"masters": "reduction", "page": "page", "push": "s3", "reduce": "reduction", "stack": "reduction"}
EXTRAS |= {"validate": "reduction"}
# What a job answers without Spark.
_WITHOUT = {"-h", "--help", "--dry-run"}


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: the job's or module's own; 2 where there is no such command."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    here = arguments[:1] == ["--local"]
    word, *rest = arguments[here:] or ["--help"]
    if word in ("-h", "--help", "--version"):
        said = f"truesky {__version__}" if word == "--version" else f"{__doc__}\ntruesky {__version__}"
        # Whoever reads it may close the pipe after the first lines.
        return command.status("truesky", lambda: print(said) or 0)
    if word in MODULES:
        return _module_command(word, rest)
    if word not in JOBS and word != "run":
        known = ", ".join(sorted({"run", *JOBS, *MODULES}))
        return command.say("truesky", f"{word} is no command of truesky: {known}; truesky --help says more", 2)
    cut = rest.index("--") if "--" in rest else len(rest)
    own, options = rest[:cut], rest[cut + 1 :]
    if here and options:
        return command.say("truesky", f"--local: no spark-submit is called that could take {options[0]}", 2)
    return _started(word, own, options, here or not _WITHOUT.isdisjoint(own))


def _module_command(word: str, rest: Sequence[str]) -> int:
    """Run a command that is a module; returns its exit status, or 2 if an optional package is missing."""
    module, with_word = MODULES[word]
    try:
        status: int = import_module(module).main([word, *rest] if with_word else rest)
    except ModuleNotFoundError as error:
        if word not in EXTRAS or (error.name or "").startswith(("truesky", "lake_schema")):
            raise
        remedy = f"pip install 'truesky[{EXTRAS[word]}]'"
        return command.say("truesky", f"{word} requires the package {error.name}, which is not installed: {remedy}", 2)
    return status


def _started(word: str, own: Sequence[str], options: Sequence[str], here: bool) -> int:
    def start(module: str, arguments: Sequence[str]) -> int:
        return submit.in_here(module, arguments) if here else submit.submit(module, arguments, options)

    with submit.stopping("truesky"):
        if word == "run":
            from truesky.commands import run

            return run.main(own, start)
        return command.status("truesky", lambda: _one_after_another(start, JOBS[word], own))


def _one_after_another(start: Callable[[str, Sequence[str]], int], modules: Sequence[str], own: Sequence[str]) -> int:
    """Status of the first job that fails."""
    # The request may be given without its option, as `truesky run` and `truesky check` take it.
    own = ["--request", *own] if own and not own[0].startswith("-") else own
    return next((status for module in modules if (status := start(module, own))), 0)


def entry() -> NoReturn:
    """`truesky`, as it is installed."""
    command.leave(main)


if __name__ == "__main__":
    entry()
