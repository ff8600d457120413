"""Asks a live service what its own API document allows, and what it does not.

    api_fuzz.py POLSCAN [SECONDS]

Starts the service on a small simulated rig and lets schemathesis ask, with a fixed seed: first without tokens, then with
a token of every scope, then with none and a wrong one. Fails on a status of 5xx that is not the documented 503 of a rig
that cannot scan, on answers that the document does not describe, and on any line of the log
at error level. /v1/events and /v1/preview.mjpeg never end, so what they answer to odd parameters is asked here by hand.
"""

import atexit
import http.client
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import small_twin  # noqa: E402

SEED = "20211130"
STREAMS = ("/v1/events", "/v1/preview.mjpeg")
# What a document without a single scheme of security cannot say is checked by hand below.
# Left out: ensure_resource_availability. A scan that exists need not have the file that is asked for: it may have failed.
CHECKS = "not_a_server_error,status_code_conformance,content_type_conformance,response_headers_conformance," \
    "response_schema_conformance,negative_data_rejection,positive_data_acceptance,missing_required_header," \
    "unsupported_method,allow_header_conformance,use_after_free"
JSON = {"Content-Type": "application/json"}
faults = []


def check(good, text):
    print(f"  {'ok' if good else 'FAILED'}: {text}", flush=True)
    if not good:
        faults.append(text)


class Service:
    """The service in a process of its own, with a store of its own."""

    def __init__(self, binary, folder, changes=()):
        self.folder = Path(folder)
        changes = [("store.dir", json.dumps(str(self.folder / "store"))), ("store.min_free_gib", "0.0"),
                   ("store.quota_gib", "6.0"), ("scan.queue_capacity", "2"),
                   ("api.wait_limit_s", "2.0"), ("api.listen", '"127.0.0.1:0"'), *changes]
        self.config = small_twin.write(self.folder, 8.0, changes)
        self.log = (self.folder / "log").open("wb")
        address = self.folder / "address"
        command = [binary, "serve", "--json", "--config", self.config, "--address-file", address]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=self.log)
        # Whatever ends this program, the service does not outlive it.
        atexit.register(self.process.kill)
        self.wait(address.exists, "the service does not listen")
        host, port = address.read_text().strip().rsplit(":", 1)
        self.address = (host, int(port))
        self.wait(lambda: self.ask("GET", "/readyz")[0] == 200, "the rig does not open")

    def wait(self, reached, otherwise):
        end = time.monotonic() + 60
        while not reached():
            if self.process.poll() is not None or time.monotonic() > end:
                raise SystemExit(f"{otherwise}:\n{(self.folder / 'log').read_text()}")
            time.sleep(0.05)

    def ask(self, method, path, headers=None, body=None):
        """Status, headers and body of an answer; of a stream no more than its head."""
        connection = http.client.HTTPConnection(*self.address, timeout=30)
        try:
            connection.request(method, path, body, headers or {})
            answer = connection.getresponse()
            streams = answer.status == 200 and path.split("?")[0] in STREAMS
            return answer.status, dict(answer.getheaders()), b"" if streams else answer.read()
        finally:
            connection.close()

    def stop(self):
        self.process.terminate()
        status = self.process.wait(60)
        lines = (self.folder / "log").read_text(errors="replace").splitlines()
        check(status == 0, f"the service ends in good order (exit status {status})")
        wrong = [line for line in lines if '"level":"ERROR"' in line or " ERROR " in line or "panicked" in line]
        check(not wrong, f"no client's mistake among {len(lines)} lines of the log is an error" +
              "".join(f"\n      {line}" for line in wrong[:10]))


def finished_scan(service, headers):
    """A scan with a result, so that there is something to look at."""
    body = json.dumps({"mode": "fast", "label": "first"})
    status, _, answer = service.ask("POST", "/v1/scans", {**JSON, **headers}, body)
    if status != 202:
        raise SystemExit(f"no scan: {status} {answer!r}")
    identity = json.loads(answer)["id"]
    where = f"/v1/scans/{identity}"
    pinned = lambda: service.ask("PATCH", where, {**JSON, **headers}, '{"pinned": true}')[0] == 200  # noqa: E731
    done = lambda: json.loads(service.ask("GET", where, headers)[2])["state"] == "done"  # noqa: E731
    service.wait(done, "the first scan does not end")
    check(pinned(), "a scan is done and pinned")
    return identity


def schemathesis(service, title, seconds, checks=CHECKS, headers=()):
    print(f"schemathesis, {title}, at most {seconds} s:", flush=True)
    document = service.folder / "openapi.json"
    document.write_bytes(service.ask("GET", "/openapi.json")[2])
    settings = service.folder / "schemathesis.toml"
    settings.write_text(SETTINGS)
    (service.folder / "hooks.py").write_text(HOOKS)
    command = [Path(sys.executable).parent / "schemathesis", "--config-file", settings, "run", document,
               "--url", "http://%s:%d" % service.address, "--seed", SEED, "--max-time", str(seconds),
               "--checks", checks, "--continue-on-failure", "--request-timeout", "20",
               "--warnings", "off", "--no-color", "--no-shrink", "--generation-database", "none"]
    for path in STREAMS:
        command += ["--exclude-path", path]
    for header in headers:
        command += ["-H", header]
    # Its report goes where it is read when it fails.
    done = subprocess.run(command, cwd=service.folder, capture_output=True, text=True,
                          env={**os.environ, "NO_COLOR": "1", "SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(service.folder), "COLUMNS": "160"})
    told = done.stdout + done.stderr
    if done.returncode != 0:
        print(told)
    summary = [line.strip() for line in told.splitlines() if " generated" in line or "Tested:" in line]
    check(done.returncode == 0, f"{title}: {', '.join(summary) or 'no summary'}")


def streams(service, headers):
    print("streams:")
    odd = ["", "?after=-1", "?after=x", "?after=0", "?after=18446744073709551615", "?after=18446744073709551616",
           "?after=%00", "?after=1&after=2", "?nonsense=1"]
    for query in odd:
        status = service.ask("GET", f"/v1/events{query}", headers)[0]
        check(status in (200, 422), f"GET /v1/events{query}: {status}")
    for value in ("-1", "x", "0", "99999999999999999999", '"', "a" * 4000):
        status = service.ask("GET", "/v1/events", {**headers, "Last-Event-ID": value})[0]
        check(status in (200, 400, 422), f"GET /v1/events with Last-Event-ID {value[:24]}: {status}")
    status = service.ask("GET", "/v1/preview.mjpeg?x=1", headers)[0]
    check(status in (200, 503), f"GET /v1/preview.mjpeg: {status}")


def operations(service):
    document = json.loads(service.ask("GET", "/openapi.json")[2])
    for path, methods in document["paths"].items():
        for method in methods:
            yield method.upper(), path


def refused(service, identity, read):
    """Every operation of the document without a token, with a wrong one, and with one that does not reach so far."""
    open_to_all = ("/livez", "/readyz")
    asked = 0
    for method, path in operations(service):
        if path in open_to_all:
            continue
        name = "report.json" if "maps" not in path else "depth.png"
        where = path.replace("{id}", identity).replace("{name}", name)
        for token in ({}, {"Authorization": "Bearer polscan_" + "0" * 64}, {"Authorization": "Basic Zm9vOmJhcg=="}):
            status, head, body = service.ask(method, where, {**JSON, **token}, "{}")
            known = status == 401 and head.get("www-authenticate") == "Bearer" and b'"unauthorized"' in body
            asked += 1
            if not known:
                check(False, f"{method} {path} without a right token: {status}")
        if method != "GET":
            status, _, body = service.ask(method, where, {**JSON, **read}, "{}")
            asked += 1
            if status != 403 or b'"insufficient-scope"' not in body:
                check(False, f"{method} {path} with a token that only reads: {status}")
    check(asked > 60, f"{asked} requests without the right to them were refused by 401 or 403")


def token(binary, file, scope):
    made = subprocess.run([binary, "token", "add", scope, "--scope", scope, "--file", file],
                          check=True, capture_output=True, text=True)
    return {"Authorization": f"Bearer {made.stdout.strip()}"}


def main(binary, seconds):
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        service = Service(binary, folder)
        finished_scan(service, {})
        schemathesis(service, "without tokens", seconds)
        streams(service, {})
        service.stop()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tokens"
        tokens = {scope: token(binary, file, scope) for scope in ("read", "scan", "admin")}
        service = Service(binary, folder, [("api.tokens", '"tokens"')])
        identity = finished_scan(service, tokens["admin"])
        refused(service, identity, tokens["read"])
        header = "Authorization: " + tokens["admin"]["Authorization"]
        schemathesis(service, "with a token of every scope", seconds // 2, headers=[header])
        conform = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"
        schemathesis(service, "without a right token", seconds // 4, conform, ["Authorization: Bearer polscan_00"])
        header = "Authorization: " + tokens["read"]["Authorization"]
        schemathesis(service, "with a token that only reads", seconds // 4, conform, [header])
        streams(service, tokens["read"])
        service.stop()
    print(f"{time.monotonic() - start:.0f} s, {len(faults)} faults")
    return 1 if faults else 0


SETTINGS = """
[checks]
# 503 says that the rig cannot scan now, which is documented.
not_a_server_error.expected-statuses = ["2xx", "3xx", "4xx", "503"]

# How many patterns there are is the projector's to say, and not the document's.
[[operations]]
include-name = "PUT /v1/projector"

[operations.checks]
positive_data_acceptance.expected-statuses = ["2xx", "401", "403", "409", "422", "429", "5xx"]

# Which calibrations there are is the store's to say.
[[operations]]
include-name = "POST /v1/calibrations/polarization"

[operations.checks]
positive_data_acceptance.expected-statuses = ["2xx", "401", "403", "409", "422", "429", "5xx"]

# What makes a board is more than its document says.
[[operations]]
include-name = "POST /v1/calibrations/rig"

[operations.checks]
positive_data_acceptance.expected-statuses = ["2xx", "401", "403", "409", "422", "429", "5xx"]

# Nothing is calibrated under other names, whatever comes along.
[[operations]]
include-name = "POST /v1/calibrations/{id}"

[operations.checks]
positive_data_acceptance.expected-statuses = ["404", "401", "403"]
"""

HOOKS = """
import itertools, re, schemathesis

count = itertools.count()

# Whoever watches the polarizer has the rig: not for so long that nobody else is answered anything but 409.
@schemathesis.hook
def before_call(context, case, kwargs):
    body = case.body
    watched = body.get("watch_s") if isinstance(body, dict) else None
    if type(watched) in (int, float) and 1 < watched <= 3600:
        case.body = {**body, "watch_s": 1}
    new_key(case)

# A key that was used for another request is refused, as it should be: each request gets one of its own.
def new_key(case):
    for name, value in list((case.headers or {}).items()):
        if name.lower() == "idempotency-key" and re.fullmatch("[ -~]{1,255}", str(value)):
            case.headers[name] = f"{value[:200]}-{next(count)}"
"""


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    sys.exit(main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 60))
