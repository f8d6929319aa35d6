"""Object stores for tests: folders, and buckets of an S3 server on loopback."""

import os
import uuid
from functools import cache
from typing import Any

import boto3
import pytest
from moto.server import ThreadedMotoServer

from service.storage.objects import ObjectStore, open_store

CREDENTIALS = {"aws_access_key_id": "test", "aws_secret_access_key": "test"}
REGION = "us-east-1"


@cache
def s3_endpoint() -> str:
    """Address of the session's S3 server; the first call starts it, as a thread.

    What opens a bucket by its address alone, also in a child process, finds it in the environment.
    """
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    os.environ.update(
        {name.upper(): text for name, text in CREDENTIALS.items()},
        AWS_REGION=REGION,
        AWS_ENDPOINT_URL=endpoint,
        AWS_ALLOW_HTTP="true",
    )
    return endpoint


def open_s3_client() -> Any:
    """A client of the S3 server, beside the program; the caller closes it."""
    return boto3.client("s3", endpoint_url=s3_endpoint(), region_name=REGION, **CREDENTIALS)


def make_bucket() -> str:
    """Make a bucket, and return the address of a store in it."""
    client, name = open_s3_client(), f"lagid-{uuid.uuid4().hex}"
    client.create_bucket(Bucket=name)
    client.close()
    return f"s3://{name}/lagid"


@pytest.fixture
def bucket() -> str:
    """Address of a store in a bucket of its own."""
    return make_bucket()


@pytest.fixture(params=["folder", "bucket"])
def store(request: pytest.FixtureRequest, tmp_path: Any) -> ObjectStore:
    """An object store of both kinds."""
    if request.param == "folder":
        return open_store(f"file://{tmp_path}/objects")
    return open_store(request.getfixturevalue("bucket"))
