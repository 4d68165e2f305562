"""HTTP handlers of the asynchronous jobs of the TAP service, at the addresses that the UWS standard defines.

References
----------
IVOA Recommendation UWS 1.1, section 2
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from datetime import UTC, datetime

from aiohttp import web

from lake_schema.errors import BadInput
from truesky.explore import votables
from truesky.page import downloads
from truesky.page.access_control import limit_body
from truesky.page.lake_session import iterate_in_thread
from truesky.page.tap import descriptions
from truesky.page.tap.queries import RETENTION, Job, Jobs

_XML, _TEXT = "text/xml", "text/plain"
_MAX_WAIT = 60.0
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


async def read_parameters(request: web.Request) -> dict[str, str]:
    """Return the parameters of an HTTP request from its address and, for POST, from its form; names are upper-case.

    BadInput is raised if the form cannot be read or contains a file, or if a parameter contains a character that XML
    does not allow, because documents about jobs contain the parameters.
    """
    values = {name.upper(): value for name, value in request.query.items()}
    if request.method == "POST":
        try:
            async with limit_body():
                form = await request.post()
        except (ValueError, LookupError) as error:
            raise BadInput(f"the form of the request cannot be read: {error}") from None
        for name, value in form.items():
            if not isinstance(value, str):
                raise BadInput(f"{name[:40]} must be a string: uploads are not supported")
            values[name.upper()] = value
    for name, value in values.items():
        if forbidden := votables.NOT_XML.search(name + value):
            raise BadInput(f"{name[:40]} contains the character U+{ord(forbidden[0]):04X}, which XML does not allow")
    return values


class Routes:
    """HTTP handlers of the addresses below /async: the list of jobs, single jobs, their properties and results.

    Parameters
    ----------
    jobs : Jobs
        All jobs of the service.
    address : callable
        Function that returns the URL of the service for an HTTP request.
    max_seconds : callable
        Function without arguments that returns the largest time limit of a query in seconds.
    """

    def __init__(self, jobs: Jobs, address: Callable[[web.Request], str], max_seconds: Callable[[], float]) -> None:
        self._jobs, self._address, self._max_seconds = jobs, address, max_seconds

    def add(self, router: web.UrlDispatcher, path: str, wrap: Callable[[Handler], Handler]) -> None:
        """Add the addresses below /async and their handlers to an application.

        Parameters
        ----------
        router : aiohttp.web.UrlDispatcher
            Router of the application.
        path : str
            Path of the TAP service, without /async.
        wrap : callable
            Function that wraps a handler, so that its errors become HTTP responses.
        """
        router.add_get(f"{path}/async", wrap(self._list))
        router.add_post(f"{path}/async", wrap(self._create))
        router.add_get(f"{path}/async/{{job}}", wrap(self._describe_job))
        router.add_post(f"{path}/async/{{job}}", wrap(self._change))
        router.add_delete(f"{path}/async/{{job}}", wrap(self._delete))
        router.add_get(f"{path}/async/{{job}}/{{part}}", wrap(self._job_attribute))
        router.add_post(f"{path}/async/{{job}}/{{part}}", wrap(self._change))
        router.add_get(f"{path}/async/{{job}}/results/result", wrap(self._result))

    def _find_job(self, request: web.Request) -> Job:
        job = self._jobs.get(request.match_info["job"])
        if job is None:
            raise web.HTTPNotFound
        return job

    def _redirect(self, request: web.Request, job: Job | None = None) -> web.Response:
        """Return an HTTP redirection to a job, or to the list of jobs if `job` is None.

        The address is absolute, because clients require it.
        """
        location = f"{self._address(request)}/async" + (f"/{job.name}" if job else "")
        return web.Response(status=303, headers={"Location": location})

    async def _list(self, request: web.Request) -> web.StreamResponse:
        address = f"{self._address(request)}/async"
        rows = [(job.name, f"{address}/{job.name}", job.phase, job.creation_time) for job in self._jobs.all()]
        phases = request.query.getall("PHASE", [])
        rows = [row for row in rows if not phases or row[2] in phases]
        return web.Response(text=descriptions.list_jobs(rows), content_type=_XML)

    async def _create(self, request: web.Request) -> web.StreamResponse:
        values = await read_parameters(request)
        phase = values.pop("PHASE", "")
        job = self._jobs.add(values, self._max_seconds())
        if phase == "RUN":
            self._jobs.start(job)
        return self._redirect(request, job)

    async def _describe_job(self, request: web.Request) -> web.StreamResponse:
        job = self._find_job(request)
        await _wait_for_change(job, request)
        facts: dict[str, object] = {
            "jobId": job.name, "runId": job.parameters.get("RUNID"), "ownerId": None, "phase": job.phase, "quote": None,
            "creationTime": job.creation_time, "startTime": job.start_time, "endTime": job.end_time,
            "executionDuration": math.ceil(job.max_seconds), "destruction": job.destruction_time,
        }  # fmt: skip
        if facts["runId"] is None:
            del facts["runId"]
        text = descriptions.describe_job(facts, job.parameters, self._result_address(request, job), job.error)
        return web.Response(text=text, content_type=_XML)

    def _result_address(self, request: web.Request, job: Job) -> str | None:
        return f"{self._address(request)}/async/{job.name}/results/result" if job.phase == "COMPLETED" else None

    async def _delete(self, request: web.Request) -> web.StreamResponse:
        self._jobs.remove(self._find_job(request).name)
        return self._redirect(request)

    async def _change(self, request: web.Request) -> web.StreamResponse:
        """Handle a POST to a job: start, abort or delete it, or change its parameters, time limit or destruction time.

        BadInput is raised for an invalid value, a property that cannot be changed, and for query parameters of a job
        that has been started.
        """
        job, values = self._find_job(request), await read_parameters(request)
        if values.get("ACTION") == "DELETE":
            return await self._delete(request)
        attribute = request.match_info.get("part", "")
        if (phase := values.pop("PHASE", None)) is not None:
            if phase not in ("RUN", "ABORT"):
                raise BadInput(f"PHASE = {phase[:40]!r} is not one of RUN, ABORT")
            (self._jobs.start if phase == "RUN" else self._jobs.abort)(job)
        elif attribute == "executionduration":
            # A duration of 0 means the limit of the service.
            job.max_seconds = _parse_seconds("EXECUTIONDURATION", values, self._max_seconds(), zero=self._max_seconds())
        elif attribute == "destruction":
            job.destruction_time = min(_parse_time("DESTRUCTION", values), job.creation_time + RETENTION)
        elif attribute in ("", "parameters"):
            if job.phase != "PENDING":
                raise BadInput("parameters can be changed only before a job is started")
            job.parameters |= values
        else:
            raise BadInput(f"{attribute[:40]} cannot be changed")
        return self._redirect(request, job)

    async def _job_attribute(self, request: web.Request) -> web.StreamResponse:
        job, attribute = self._find_job(request), request.match_info["part"]
        if attribute == "error" and job.phase == "ERROR":
            return web.Response(body=votables.refusal(job.error), content_type="application/x-votable+xml")
        if attribute == "parameters":
            return web.Response(text=descriptions.describe_parameters(job.parameters), content_type=_XML)
        if attribute == "results":
            text = descriptions.describe_results(self._result_address(request, job))
            return web.Response(text=text, content_type=_XML)
        attribute_values = {
            "phase": job.phase, "quote": "", "owner": "", "executionduration": str(math.ceil(job.max_seconds)),
            "destruction": descriptions.format_time(job.destruction_time),
        }  # fmt: skip
        if attribute not in attribute_values:
            raise web.HTTPNotFound
        return web.Response(text=attribute_values[attribute], content_type=_TEXT)

    async def _result(self, request: web.Request) -> web.StreamResponse:
        job = self._find_job(request)
        if job.phase != "COMPLETED":
            raise web.HTTPNotFound
        return await downloads.send_stream(
            request, iterate_in_thread(downloads.read_chunks(self._jobs.file(job))), job.content_type, None
        )


async def _wait_for_change(job: Job, request: web.Request) -> None:
    """Wait as the parameter WAIT of an HTTP request demands: until the phase of the job changes or the time is over.

    WAIT is a number of seconds, at most 60; -1 means 60, and 0 means no waiting. The function returns at once without
    WAIT, if the job has not been started or has ended, or if its phase is not the parameter PHASE.
    """
    parameters = {name.upper(): value for name, value in request.query.items()}
    wait = parameters.get("WAIT")
    if wait is None or job.has_ended or parameters.get("PHASE", job.phase) != job.phase:
        return
    if job.phase == "PENDING":
        return
    seconds = _MAX_WAIT if wait == "-1" else _parse_seconds("WAIT", parameters, _MAX_WAIT, zero=0.0)
    changed = job.phase_changed
    try:
        await asyncio.wait_for(changed.wait(), seconds)
    except TimeoutError:
        return


def _parse_seconds(name: str, parameters: Mapping[str, str], max_seconds: float, zero: float) -> float:
    """Parse a parameter that is a whole number of seconds.

    Parameters
    ----------
    name : str
        Name of the parameter. BadInput is raised if it is missing or not a whole number.
    parameters : mapping of str to str
        Values of all parameters by name.
    max_seconds : float
        Largest result, s; it replaces larger numbers.
    zero : float
        Result for the number 0, s.

    Returns
    -------
    float
        The time, s.
    """
    text = parameters.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise BadInput(f"{name} = {text[:40]!r} is not a number of seconds")
    return min(float(text) or zero, max_seconds)


def _parse_time(name: str, parameters: Mapping[str, str]) -> datetime:
    text = parameters.get(name, "")
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise BadInput(f"{name} = {text[:40]!r} is not a date and time in ISO 8601") from None
    return time if time.tzinfo else time.replace(tzinfo=UTC)
