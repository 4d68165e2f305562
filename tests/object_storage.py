"""An S3 service on a port of loopback, for tests: moto's, in a thread."""

import logging
import threading
from contextlib import contextmanager

import pytest

CREDENTIALS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_EC2_METADATA_DISABLED": "true"}


class Recorder:
    """Between the service and its callers: keeps what was asked, and may answer in its place."""

    def __init__(self, app):
        self.app, self.asked, self.answer, self._lock = app, [], None, threading.Lock()

    def __call__(self, environ, start_response):
        with self._lock:
            self.asked.append((environ["REQUEST_METHOD"], environ["PATH_INFO"]))
        if self.answer is not None and (status := self.answer(environ)):
            start_response(status, [("Content-Length", "0")])
            return [b""]
        return self.app(environ, start_response)

    def sent(self):
        return [path for method, path in self.asked if method == "PUT"]


class Service:
    """Address of a service, its objects by boto3, and the received requests."""

    def __init__(self, url, recorder):
        import boto3

        self.url, self.recorder = url, recorder
        self.client = boto3.client(
            "s3", endpoint_url=url, region_name="us-east-1", aws_access_key_id="test", aws_secret_access_key="test"
        )

    def names(self, bucket, prefix=""):
        pages = self.client.get_paginator("list_objects_v2").paginate(Bucket=bucket, Prefix=prefix)
        return sorted(one["Key"] for page in pages for one in page.get("Contents", ()))

    def data(self, bucket, key):
        return self.client.get_object(Bucket=bucket, Key=key)["Body"].read()


@contextmanager
def parsed_once():
    """Let clients share the parsed descriptions of the service, which every client would parse again for 0.1 s."""
    from botocore.loaders import JSONFileLoader

    load, kept = JSONFileLoader.load_file, {}

    def load_once(self, path):
        if path not in kept:
            kept[path] = load(self, path)
        return kept[path]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(JSONFileLoader, "load_file", load_once)
        yield


@contextmanager
def service():
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    recorder = Recorder(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, recorder, threaded=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        with parsed_once():
            yield Service(f"http://127.0.0.1:{server.server_port}", recorder)
    finally:
        server.shutdown()
        thread.join()
