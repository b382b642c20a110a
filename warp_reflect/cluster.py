"""Frames of a job on the workers of a dask cluster: of its own on this machine, or one that runs already.

Consecutive frames go to one worker as a batch, so that what a frame takes from the one before is at hand. A batch whose
worker is lost is given to another; a batch that loses its worker again and again is cut into frames, so that the one at
fault is found. Workers work in the folder of the caller: with a running cluster it must be shared.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import math
import queue
import signal
import threading
import uuid
from collections.abc import Callable, Iterator

from warp_reflect.launch import CORES_VARIABLE, thread_count
from warp_reflect.pipeline import FRAME_FAILURES, REUSE_RUN, Job, OpenJob, Outcome, one_line, part_of, render_places
from warp_reflect.progress import Report

SCHEDULER_SECONDS = 10.0  # how long a scheduler may take to answer
BATCH_MAX = 16  # frames; from here on a longer batch saves nothing
# A batch is so large a share of what its worker has left, so that at the end no worker is waited for long.
BATCH_SHARE = 0.34
POLL_SECONDS = 0.1
# Of the workers' allocator (glibc), before they start. dask has it hand memory back whenever 64 KB are free, and threads beside
# the first map anew whatever is large: a frame's arrays would be cleared by the system every time, for a quarter of its time.
ALLOCATOR = {"MALLOC_ARENA_MAX": 1, "MALLOC_MMAP_THRESHOLD_": 2**25, "MALLOC_TRIM_THRESHOLD_": 2**29}

_one_at_a_time = threading.Lock()  # kernels of one process are launched by one thread


def render_on_cluster(
    job: Job,
    places: list[int],
    digest: str,
    resume: bool,
    is_stopped: Callable[[], bool],
    deadline: float | None,
    workers: int,
    scheduler: str | None,
    report: Report,
) -> Iterator[Outcome]:
    """`pipeline.render_places` on a cluster; outcomes come in the order they are finished.

    Args:
        workers: Processes of a cluster on this machine; ignored with `scheduler`.
        scheduler: Address of a running one, such as tcp://host:8786.
        report: Told of what cannot be told of a frame.

    Raises:
        ValueError: dask is not installed.
        OSError: the scheduler does not answer.
        ConnectionError: it went away.
    """
    try:
        import distributed
    except ImportError:
        raise ValueError("--workers and --scheduler need dask: pip install 'warp_reflect[cluster]'") from None
    run = f"warp_reflect-{uuid.uuid4()}"
    with contextlib.ExitStack() as stack:
        report.busy("starting workers")
        client = stack.enter_context(_client(distributed, job, workers, scheduler))
        addresses = sorted(client.scheduler_info(n_workers=-1)["workers"])
        workers = len(addresses) or workers
        stop = distributed.Event(run, client=client)
        events: queue.SimpleQueue = queue.SimpleQueue()
        client.subscribe_topic(run, lambda event: events.put(event[1]["outcome"]))
        stack.callback(client.unsubscribe_topic, run)

        def submit(batch: list[int], address: str | None = None) -> None:
            part, local = job.cut(batch)
            future = client.submit(
                render_batch,
                *(part, local, batch, digest, resume, deadline, run),
                pure=False,
                priority=-batch[0],
                workers=address,
                allow_other_workers=address is not None,
            )
            waiting[future] = batch

        waiting: dict = {}
        told: set[int] = set()
        for k, part in enumerate(_parts(job, places, workers)):
            # Each worker is to have one part of the range: what a batch's first frame takes from the one before is at
            # hand. One that has nothing left may take from another, so may any where one is lost.
            for batch in part:
                submit(batch, addresses[k] if addresses else None)
        while waiting:
            with contextlib.suppress(queue.Empty):
                outcome = _from_plain(events.get(timeout=POLL_SECONDS))
                if outcome.place not in told:
                    told.add(outcome.place)
                    yield outcome
                continue
            if is_stopped() and not stop.is_set():
                stop.set()
            for future in [future for future in waiting if future.done()]:
                batch = waiting.pop(future)
                left = [place for place in batch if place not in told]
                if future.status == "finished":
                    # The events of a worker may be later than its result.
                    ended = [_from_plain(plain) for plain in future.result()]
                elif future.status == "error":
                    error = future.exception()
                    lost = isinstance(error, distributed.KilledWorker)
                    if not lost and not isinstance(error, FRAME_FAILURES):
                        raise error
                    if lost and len(left) > 1:
                        for place in left:
                            submit([place])
                        continue
                    text = "its worker died every time it was tried" if lost else one_line(error)
                    ended = [Outcome(place, "failed", text) for place in left]
                else:
                    raise ConnectionError("the scheduler was lost")
                for outcome in ended:
                    if outcome.place not in told:
                        told.add(outcome.place)
                        yield outcome


def _parts(job: Job, places: list[int], workers: int) -> list[list[list[int]]]:
    """Every worker's part of a range, in batches of consecutive frames that become shorter towards its end.

    What reuses from frame to frame is cut only where that starts afresh.
    """
    if job.reuses:
        runs = [list(run) for _, run in itertools.groupby(places, key=lambda place: place // REUSE_RUN)]
        return [[runs[k] for k in part_of(len(runs), (w, workers))] for w in range(1, workers + 1)]
    parts = []
    for w in range(1, workers + 1):
        left, part = [places[k] for k in part_of(len(places), (w, workers))], []
        while left:
            size = min(BATCH_MAX, math.ceil(BATCH_SHARE * len(left)))
            part.append(left[:size])
            left = left[size:]
        parts.append(part)
    return parts


@contextlib.contextmanager
def _client(distributed, job: Job, workers: int, scheduler: str | None) -> Iterator:
    """A client of a running scheduler, or of a cluster that lives as long as this context."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters of it is told of the frames
    if scheduler is not None:
        # Of an address that is none dask would leave half a client behind, which complains when it is deleted.
        try:
            scheme, place = distributed.comm.addressing.parse_address(scheduler)
            distributed.comm.registry.get_backend(scheme)
            distributed.comm.addressing.parse_host_port(place)
        except ValueError as error:
            raise ValueError(
                f"--scheduler: got '{scheduler}', expected an address as tcp://host:8786 ({error})"
            ) from None
        try:
            client = distributed.Client(scheduler, timeout=SCHEDULER_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise OSError(
                f"--scheduler {scheduler}: no answer within {SCHEDULER_SECONDS:g} s ({one_line(error)})"
            ) from None
        with client:
            yield client
            with contextlib.suppress(OSError):
                client.run(_forget)
        return
    threads = str(max(thread_count("cpu") // workers, 1))
    import dask

    key = "distributed.nanny.pre-spawn-environ"
    with dask.config.set({key: dask.config.get(key) | ALLOCATOR}):
        cluster = distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            # Nothing listens beyond this machine.
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            silence_logs=logging.CRITICAL,
            memory_limit=0,  # frames hold what they need: there is nothing to spill
            env={CORES_VARIABLE: threads, "OPENIMAGEIO_THREADS": threads},
            preload=__name__,
        )
    with cluster, distributed.Client(cluster, set_as_default=False) as client:
        yield client


def dask_setup(_worker) -> None:
    """What dask calls in each worker of a cluster of ours as it starts.

    Control-C on a terminal reaches every process; the one that was asked decides what it means.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def render_batch(
    job: Job, local: list[int], places: list[int], digest: str, resume: bool, deadline: float | None, run: str
) -> list[dict]:
    """Render consecutive frames on a worker; tells of each on the topic `run` and returns them all.

    Args:
        job: The job, cut to these frames.
        local: Their places in it.
        places: Their places in the whole job.
        digest: Of the stage's files.
        resume: Keep frames that are done.
        deadline: See `render_places`.
        run: Name of the topic, and of the event that stops it.
    """
    from distributed import Event, get_worker

    from warp_reflect.devices import open_device

    worker, stop = get_worker(), Event(run)
    done = []
    with _one_at_a_time, contextlib.chdir(job.folder):
        opened = _opened(worker, job, digest)
        if not opened:
            open_device(job.load.get("device", "cpu"))
        whole = dict(zip(local, places, strict=True))
        for outcome in render_places(job, local, digest, opened, resume, stop.is_set, deadline):
            done.append(dataclasses.asdict(dataclasses.replace(outcome, place=whole[outcome.place])))
            worker.log_event(run, {"outcome": done[-1]})
    return done


def _opened(worker, job: Job, digest: str) -> list[OpenJob]:
    """What a worker holds open, kept on the worker from batch to batch of one job."""
    same = dataclasses.replace(job, times=(), files=(), numbers=()), digest
    known = getattr(worker, "warp_reflect_opened", None)
    if known is None or known[0] != same:
        known = worker.warp_reflect_opened = (same, [])
    for opened in known[1]:
        opened.job = job
    return known[1]


def _forget(dask_worker) -> None:
    """Free what a worker that lives on held open."""
    dask_worker.warp_reflect_opened = None


def _from_plain(plain: dict) -> Outcome:
    return Outcome(**plain | {"notes": tuple(tuple(note) for note in plain["notes"])})
