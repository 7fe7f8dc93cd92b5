"""An S3 server on this machine, and nothing of the user's settings."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from typing import Any

import pytest


@contextlib.contextmanager
def serving_s3() -> Iterator[str]:
    """Serve empty S3 while the body runs: its address."""
    pytest.importorskip("s3fs")
    moto_server = pytest.importorskip("moto.server")
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@contextlib.contextmanager
def buckets(endpoint: str, patch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The server's files, with botocore kept to this machine, whatever the user has set up."""
    for name in ("AWS_PROFILE", "AWS_SESSION_TOKEN", "HTTP_PROXY", "http_proxy"):
        patch.delenv(name, raising=False)
    for name, value in settings(endpoint).items():
        patch.setenv(name, value)
    files = s3_files()
    yield files
    forget(files)


def settings(endpoint: str) -> dict[str, str]:
    """Variables with which botocore uses the server, and nothing that the user has set up."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": "/nonexistent",
        "AWS_SHARED_CREDENTIALS_FILE": "/nonexistent",
        "AWS_EC2_METADATA_DISABLED": "true",
    }


def s3_files() -> Any:
    """The files as the project opens them."""
    from replay.storage.servers import s3_files as files

    return files()


def forget(files: Any) -> None:
    """Close the connections now, while their loop runs."""
    client = getattr(files, "_s3creator", None)
    if client is not None:
        end = client.__aexit__(None, None, None)
        asyncio.run_coroutine_threadsafe(end, files.loop).result(10)
    type(files).clear_instance_cache()
