"""HTTP with limits for each phase, for http and https only; what goes wrong is sorted by what may help."""

from __future__ import annotations

import errno
import queue
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection, IncompleteRead
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import (
    AbstractHTTPHandler,
    HTTPDefaultErrorHandler,
    HTTPErrorProcessor,
    HTTPRedirectHandler,
    OpenerDirector,
    ProxyHandler,
    Request,
    UnknownHandler,
    getproxies,
)

from sb3_dce.errors import SB3DCEError


@dataclass(frozen=True)
class Patience:
    """
    How long to wait for what, in seconds.

    :param lookup: for the address of a host; without network the system itself would wait for 20 s and more
    :param connect: for a connection
    :param read: for the next bytes
    :param waits: before each further attempt at the same URL, so their number is that of the retries
    :param lock: for another process that downloads the same file
    """

    lookup: float = 1.5
    connect: float = 10.0
    read: float = 30.0
    waits: tuple[float, ...] = (0.5, 1.0, 2.0)
    lock: float = 3600.0


@dataclass(eq=False)
class Failed(Exception):
    """
    An attempt at a URL has failed.

    :param what: what was seen
    :param retry: another attempt at the URL may help
    :param discard: the bytes received so far are of no use
    :param damaged: the URL delivers something else than the file
    :param unreachable: the host cannot be reached, so its other URLs need no attempt
    """

    what: str
    retry: bool = False
    discard: bool = False
    damaged: bool = False
    unreachable: bool = False


def make_opener(patience: Patience) -> OpenerDirector:
    """
    urllib's opener without its handlers of files, FTP and data, so that no redirect can lead there. Proxies are honoured.

    :param patience: times to wait
    :return: opener
    """
    proxies = {scheme: url for scheme, url in getproxies().items() if scheme in ("http", "https")}
    opener = OpenerDirector()
    for handler in (
        ProxyHandler(proxies),
        _Handler(patience),
        HTTPRedirectHandler(),
        HTTPErrorProcessor(),
        HTTPDefaultErrorHandler(),
        UnknownHandler(),
    ):
        opener.add_handler(handler)
    return opener


@contextmanager
def network_errors() -> Iterator[None]:
    """
    What the network raises, sorted by whether another attempt has a chance.

    :raises Failed: in its place; errors of this package are left as they are
    """
    try:
        yield
    except SB3DCEError:
        raise
    except HTTPError as exc:
        with exc:
            range_refused = exc.code == 416
            retry = exc.code == 429 or exc.code >= 500 or range_refused
            raise Failed(f"HTTP {exc.code} {exc.reason}", retry=retry, discard=range_refused) from exc
    except (OSError, HTTPException, ValueError) as exc:
        reason = exc.reason if isinstance(exc, URLError) else exc
        if isinstance(reason, (TimeoutError, ConnectionResetError, ConnectionAbortedError, BrokenPipeError, IncompleteRead)):
            raise Failed(f"connection lost: {reason!s}", retry=True) from exc
        refused = isinstance(reason, ConnectionRefusedError)
        no_way = isinstance(reason, OSError) and reason.errno in (errno.ENETUNREACH, errno.EHOSTUNREACH, errno.EHOSTDOWN)
        unreachable = refused or no_way or isinstance(reason, socket.gaierror)
        raise Failed(f"no connection: {reason!s}", unreachable=unreachable) from exc


class _Connection(HTTPConnection):
    """A connection with a limit of its own for each phase; ``timeout`` is that of reading."""

    def __init__(self, host: str, *, patience: Patience, **options: Any) -> None:
        super().__init__(host, **options)
        self._patience = patience

    def connect(self) -> None:
        """Look the host up, connect, and from then on wait for bytes."""
        _look_up(self.host, self.port, self._patience.lookup)
        self.timeout = self._patience.connect
        super().connect()
        self.sock.settimeout(self._patience.read)


class _SecureConnection(_Connection, HTTPSConnection):
    """The same with TLS."""


class _Handler(AbstractHTTPHandler):
    def __init__(self, patience: Patience) -> None:
        super().__init__()
        self._patience = patience

    def http_open(self, request: Request) -> HTTPResponse:
        return self.do_open(partial(_Connection, patience=self._patience), request)

    def https_open(self, request: Request) -> HTTPResponse:
        return self.do_open(partial(_SecureConnection, patience=self._patience), request)

    http_request = https_request = AbstractHTTPHandler.do_request_


def _look_up(host: str, port: int, limit: float) -> None:
    """Fail within a limit if the name has no address; ``getaddrinfo`` itself cannot be limited."""
    answers: queue.SimpleQueue[Exception | None] = queue.SimpleQueue()

    def ask() -> None:
        try:
            socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            answers.put(None)
        except Exception as exc:
            answers.put(exc)

    threading.Thread(target=ask, daemon=True).start()
    try:
        error = answers.get(timeout=limit)
    except queue.Empty:
        error = socket.gaierror(socket.EAI_AGAIN, f"no answer of the name server in {limit:g} s")
    if error is not None:
        raise error
