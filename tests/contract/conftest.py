"""A bucket of an S3 server in this process."""

import uuid

import boto3
import pytest
from moto.server import ThreadedMotoServer

CREDENTIALS = {"aws_access_key_id": "test", "aws_secret_access_key": "test"}


@pytest.fixture(scope="session")
def s3_endpoint():
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def bucket(s3_endpoint):
    """Options of a store in a fresh bucket, and its address."""
    name = f"lagid-{uuid.uuid4().hex}"
    client = boto3.client("s3", endpoint_url=s3_endpoint, region_name="us-east-1", **CREDENTIALS)
    client.create_bucket(Bucket=name)
    client.close()
    options = {
        "endpoint": s3_endpoint,
        "region": "us-east-1",
        **CREDENTIALS,
        "client_options": {"allow_http": True},
    }
    return f"s3://{name}/lagid", options
