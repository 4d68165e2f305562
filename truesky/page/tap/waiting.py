"""Addresses of the jobs of a TAP service, as UWS wants them.

Ref: IVOA Recommendation UWS 1.1, section 2
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime

from aiohttp import web

from lake_schema.errors import BadInput
from truesky.explore import votables
from truesky.page import downloads
from truesky.page.opened import pieces
from truesky.page.tap import descriptions
from truesky.page.tap.queries import KEPT, Job, Jobs

_XML, _TEXT = "text/xml", "text/plain"
_LONGEST_WAIT = 60.0
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


async def parameters(request: web.Request) -> dict[str, str]:
    """What a tool asks with, in the address or as a form; names in capitals.  Errors: BadInput for a file"""
    found = {name.upper(): value for name, value in request.query.items()}
    if request.method == "POST":
        for name, value in (await request.post()).items():
            if not isinstance(value, str):
                raise BadInput(f"{name[:40]}: this service takes no files")
            found[name.upper()] = value
    return found


class Routes:
    """Handlers of the addresses below async.

    address : of the service, for a request;  check : refuses a question;  seconds : that a question may take
    """

    def __init__(
        self,
        jobs: Jobs,
        address: Callable[[web.Request], str],
        check: Callable[[dict[str, str]], None],
        seconds: Callable[[], float],
    ) -> None:
        self._jobs, self._address, self._check, self._seconds = jobs, address, check, seconds

    def add(self, router: web.UrlDispatcher, path: str, told: Callable[[Handler], Handler]) -> None:
        """Answer below a path; `told` says what is refused."""
        router.add_get(f"{path}/async", told(self._list))
        router.add_post(f"{path}/async", told(self._new))
        router.add_get(f"{path}/async/{{job}}", told(self._job))
        router.add_post(f"{path}/async/{{job}}", told(self._change))
        router.add_delete(f"{path}/async/{{job}}", told(self._delete))
        router.add_get(f"{path}/async/{{job}}/{{part}}", told(self._part))
        router.add_post(f"{path}/async/{{job}}/{{part}}", told(self._change))
        router.add_get(f"{path}/async/{{job}}/results/result", told(self._result))

    def _known(self, request: web.Request) -> Job:
        job = self._jobs.get(request.match_info["job"])
        if job is None:
            raise web.HTTPNotFound
        return job

    def _there(self, request: web.Request, job: Job | None = None) -> web.Response:
        """Lead to a job, or to their list; tools want absolute addresses."""
        where = f"{self._address(request)}/async" + (f"/{job.name}" if job else "")
        return web.Response(status=303, headers={"Location": where})

    async def _list(self, request: web.Request) -> web.StreamResponse:
        address = f"{self._address(request)}/async"
        rows = [(job.name, f"{address}/{job.name}", job.phase, job.made) for job in self._jobs.all()]
        wanted = request.query.getall("PHASE", [])
        rows = [row for row in rows if not wanted or row[2] in wanted]
        return web.Response(text=descriptions.jobs(rows), content_type=_XML)

    async def _new(self, request: web.Request) -> web.StreamResponse:
        given = await parameters(request)
        phase = given.pop("PHASE", "")
        job = self._jobs.add(given, self._seconds())
        if phase == "RUN":
            self._jobs.start(job)
        return self._there(request, job)

    async def _job(self, request: web.Request) -> web.StreamResponse:
        job = self._known(request)
        await _waited(job, request)
        facts: dict[str, object] = {
            "jobId": job.name, "runId": job.parameters.get("RUNID"), "ownerId": None, "phase": job.phase, "quote": None,
            "creationTime": job.made, "startTime": job.started, "endTime": job.ended,
            "executionDuration": math.ceil(job.most_seconds), "destruction": job.destroyed,
        }  # fmt: skip
        if facts["runId"] is None:
            del facts["runId"]
        text = descriptions.job(facts, job.parameters, self._result_address(request, job), job.error)
        return web.Response(text=text, content_type=_XML)

    def _result_address(self, request: web.Request, job: Job) -> str | None:
        return f"{self._address(request)}/async/{job.name}/results/result" if job.phase == "COMPLETED" else None

    async def _delete(self, request: web.Request) -> web.StreamResponse:
        self._jobs.remove(self._known(request).name)
        return self._there(request)

    async def _change(self, request: web.Request) -> web.StreamResponse:
        """Start, abort or delete a job, or change a parameter of one that waits."""
        job, given = self._known(request), await parameters(request)
        if given.get("ACTION") == "DELETE":
            return await self._delete(request)
        part = request.match_info.get("part", "")
        if (phase := given.pop("PHASE", None)) is not None:
            if phase not in ("RUN", "ABORT"):
                raise BadInput(f"PHASE = {phase[:40]!r} is not one of RUN, ABORT")
            (self._jobs.start if phase == "RUN" else self._jobs.abort)(job)
        elif part == "executionduration":
            job.most_seconds = _seconds(given.get("EXECUTIONDURATION", ""), self._seconds())
        elif part == "destruction":
            job.destroyed = min(_moment(given.get("DESTRUCTION", "")), job.made + KEPT)
        elif part in ("", "parameters"):
            if job.phase != "PENDING":
                raise BadInput("parameters can be changed only before a job is started")
            job.parameters |= given
        else:
            raise BadInput(f"{part[:40]} cannot be changed")
        return self._there(request, job)

    async def _part(self, request: web.Request) -> web.StreamResponse:
        job, part = self._known(request), request.match_info["part"]
        if part == "error" and job.phase == "ERROR":
            return web.Response(body=votables.refusal(job.error), content_type="application/x-votable+xml")
        if part == "parameters":
            return web.Response(text=descriptions.parameters_of(job.parameters), content_type=_XML)
        if part == "results":
            text = descriptions.results_of(self._result_address(request, job))
            return web.Response(text=text, content_type=_XML)
        texts = {
            "phase": job.phase, "quote": "", "owner": "", "executionduration": str(math.ceil(job.most_seconds)),
            "destruction": descriptions.moment(job.destroyed),
        }  # fmt: skip
        if part not in texts:
            raise web.HTTPNotFound
        return web.Response(text=texts[part], content_type=_TEXT)

    async def _result(self, request: web.Request) -> web.StreamResponse:
        job = self._known(request)
        if job.phase != "COMPLETED":
            raise web.HTTPNotFound
        return await downloads.sent(request, pieces(downloads.chunks(self._jobs.file(job))), job.kind, None)


async def _waited(job: Job, request: web.Request) -> None:
    """WAIT=s: answer only when the phase changes, or the job has ended."""
    wait = request.query.get("WAIT")
    if wait is None or job.has_ended or request.query.get("PHASE", job.phase) != job.phase:
        return
    if job.phase == "PENDING":
        return
    seconds = _LONGEST_WAIT if wait == "-1" else min(_seconds(wait, _LONGEST_WAIT), _LONGEST_WAIT)
    changed = job.changed
    try:
        await asyncio.wait_for(changed.wait(), seconds)
    except TimeoutError:
        return


def _seconds(text: str, most: float) -> float:
    """Whole seconds, 0 = as many as possible."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise BadInput(f"{text[:40]!r} is not a number of seconds")
    return min(float(text) or most, most)


def _moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise BadInput(f"{text[:40]!r} is not a moment, ISO 8601") from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
