"""Send a service random requests for some minutes, and count the statuses of its answers.

Requests come from the OpenAPI document that the service serves. They follow its links: a dataset
that was stored is named in a job, the job's runs are read, simulated and exported. Every second
request is damaged: other values anywhere in a body, foreign names, hosts, headers and queries,
torn files. An answer of 500 is a fault of the service. So is 503 without `Retry-After`, and a
status that the OpenAPI document does not have.
"""

import copy
import json
import random
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from benchmarks import paper_example
from benchmarks.breaking.stand import Stand, standing_service
from benchmarks.table import Row, parser, report

HTTP_METHODS = ("get", "post", "put", "delete", "patch", "head", "options")
PAGES = ("/", "/new", "/datasets", "/docs", "/jobs/{job_id}", "/datasets/{dataset_id}")
PAGES += (
    "/runs/{run_id}",
    "/compare",
    "/paper",
    "/simulate",
    "/recipes/noise-sweep",
    "/problems/x",
)
JSON, YAML, CSV, MCAP = "application/json", "application/yaml", "text/csv", "application/x-mcap"
SMALL_SEARCH = {"generations": 5, "population": 20, "islands": 2, "stop": {"seconds": 2}}
TRUTH = {
    "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
    "samples": 90,
    "sample_time": 0.1,
    "inputs": {"u": {"kind": "step"}},
}
OWN_MODEL: dict[str, Any] = {
    "name": "own",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "m"},
    "parameters": {"T": {"lower": 1, "upper": 9}, "L": {"lower": 0, "upper": 2}},
    "equations": {"x": "(u(t - L) - x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": "steady"},
}
NAMES = ["K", "L", "x(0)", "x(0)[2]", "u", "y", "fopdt", "/seed", "1/0", "x**x", "\ud800", "\x00"]
NAMES += ["", "é", "=1", "previous", "a" * 5000, "../../etc/passwd", "%00", "{}", "<script>"]
NUMBERS = [0, -1, 0.5, 1e308, -1e308, 5e-324, 2**31, 2**63, 10**30, 10**400]
NUMBERS += [float("nan"), float("inf"), 1e-300]
HOSTS = ["evil.example", "127.0.0.1", "[::1]", "localhost.", "", "a" * 3000, "127.0.0.1:99999999"]
HOSTS += ["localhost:", "127.0.0.1@evil", "0x7f.1", "127.0.0.1, evil.example"]
FOREIGN = b"\xe9"
"""A header value that is no ASCII."""
TYPES = ["", "text/plain", "x", JSON, YAML, CSV, FOREIGN]
ETAGS = ["*", '"a"', FOREIGN, ""]
KEYS = ["1", "k", "9" * 5000, FOREIGN]
EQUATIONS = [
    "x(t - x)",
    "u(t + L)",
    "x/0",
    "where(x > 0, 1/x, log(x))",
    "(" * 200 + "x",
    "x" * 4001,
]
EQUATIONS += [
    "tanh(" * 60 + "x" + ")" * 60,
    "+".join(["x*u(t - L)"] * 300),
    "x**1e300",
    "pi",
    "-" * 900,
]
EQUATIONS += ["+".join(f"u(t - L*{n}.5)" for n in range(200)), "x(t-L)(t-L)", "h*k", "max()", "x;1"]
EQUATIONS += [
    "rate - x/T",
    "rate(t - L) - rate*x",
    "u(t - late) - x",
    "table(u, [-1, 0, 2], [0, L, 5]) - x/T",
    "pchip(x, [0, 1e-300, 1, 1e300], [0, L, T, -1e300])",
    "table(x, [0, 0], [1, 2])",
    "pchip(u, [" + ", ".join(map(str, range(128))) + "], [" + ", ".join(["L"] * 128) + "])",
    "table(table(x, [0, 1], [2, 3]), [0, x], [[1], 2])",
    "u(t - L/(0.1 + abs(u))) - x",
    "u(t - L/u) - x",
    "u(t - u) - x(t - u)",
    "u(t - L/x(t - u(t - L)))",
    "mod(x, u) - clip(x, T, -T)*floor(1e300*x)",
    "erf(x)*sinh(900*u) - cosh(x)/log10(L) + atan2(u, x)",
    "if(x > 0, 1, sat(x'))",
    "x² + 0,5^x ? [1, 2]",
]
NAMES_OF_LET: list[Any] = [
    {"rate": "L*exp(-x/T)", "late": "L/2"},
    {"rate": "late*u", "late": "rate"},
    {"rate": "u(t - L/(1 + u**2))", "late": "x"},
    {"rate": "table(u, [0, 1], [late, T])", "late": "clip(L, 0.1, 1)"},
    {f"a{n}": f"a{n + 1}*a{n + 1}" for n in range(60)} | {"a60": "x", "rate": "a0", "late": "1"},
    {"rate": None, "L": "1", "x": [], "1": "sin"},
    [],
]


@dataclass
class Outcome:
    """Counts of the answers; `faults` are the first requests of each kind that went wrong."""

    by_status: Counter[int] = field(default_factory=Counter)
    operations: set[str] = field(default_factory=set)
    faults: dict[str, str] = field(default_factory=dict)
    undocumented: set[str] = field(default_factory=set)
    kinds: Counter[str] = field(default_factory=Counter)
    slowest: tuple[float, str] = (0.0, "")


class Requests:
    """Random requests to the operations of an OpenAPI document."""

    def __init__(self, schema: dict[str, Any], draw: random.Random) -> None:
        self._draw, self._schema = draw, schema
        self.operations = [
            (method, path, operation)
            for path, methods in schema["paths"].items()
            for method, operation in methods.items()
            if method in HTTP_METHODS
        ]
        self.pool: dict[str, list[str]] = {"dataset_id": [], "job_id": [], "run_id": [], "name": []}
        self.pool["name"] += ["fopdt", "own", "fit", "convergence", "best", "tank"]

    def remember(self, document: Any) -> None:
        """Keep the identifiers of an answer for later requests."""
        if isinstance(document, dict):
            for value in document.values():
                self.remember(value)
        elif isinstance(document, list):
            for value in document[:20]:
                self.remember(value)
        elif isinstance(document, str):
            for prefix, name in (("ds_", "dataset_id"), ("job_", "job_id"), ("run_", "run_id")):
                if document.startswith(prefix) and len(document) < 60:
                    self.pool[name] = [*self.pool[name], document][-60:]

    def make(self) -> tuple[str, str, dict[str, Any], dict[str, Any]]:
        """Make a request: method, template of its path, arguments of httpx, operation."""
        draw = self._draw
        if draw.random() < 0.08:
            path = draw.choice(PAGES)
            arguments = {"params": self._make_query([]), "headers": {"accept": "text/html"}}
            return "get", path, {"url": self._fill(path), **arguments}, {}
        method, path, operation = draw.choice(self.operations)
        arguments = {"url": self._fill(path), "headers": {}}
        named = [p for p in operation.get("parameters", []) if p["in"] == "query"]
        arguments["params"] = self._make_query(named)
        for parameter in operation.get("parameters", []):
            if parameter["in"] == "header" and draw.random() < 0.5:
                arguments["headers"][parameter["name"]] = draw.choice(
                    ["1", "k", "9" * 5000, FOREIGN]
                )
        if "requestBody" in operation:
            self._add_body(path, operation, arguments)
        if draw.random() < 0.1:
            self._damage_head(arguments)
        return method, path, arguments, operation

    def _fill(self, path: str) -> str:
        for name, known in self.pool.items():
            foreign = not known or self._draw.random() < 0.07
            value = self._draw.choice(NAMES if foreign else known)
            quoted = "".join(
                c if c.isalnum() or c in "_-." else f"%{b:02X}"
                for c in value
                for b in c.encode("utf-8", "surrogatepass")[:1]
            )
            path = path.replace("{" + name + "}", quoted or "%20")
        return path

    def _make_query(self, parameters: list[dict[str, Any]]) -> list[tuple[str, str]]:
        draw, query = self._draw, []
        for parameter in parameters:
            if draw.random() < 0.35:
                value = self.generate(parameter["schema"])
                value = draw.choice(NAMES) if draw.random() < 0.3 else value
                values = value if isinstance(value, list) else [value]
                query += [(parameter["name"], _to_text(item)) for item in values]
        if draw.random() < 0.05:
            cursors = ["[null,999999999999999999999999]", "[true,true]", "W10", "9" * 5000, "[]"]
            query.append((draw.choice(["cursor", "by", "theme", "zzz"]), draw.choice(cursors)))
        return query

    def _add_body(self, path: str, operation: dict[str, Any], arguments: dict[str, Any]) -> None:
        draw, content = self._draw, operation["requestBody"]["content"]
        kind = draw.choice(list(content))
        if kind in (CSV, MCAP, "multipart/form-data"):
            body = self.make_file(kind)
            kind = CSV if kind.startswith("multipart") else kind
        else:
            schema = content.get(JSON, {}).get("schema", {})
            document = self._choose_document(path) if draw.random() < 0.7 else None
            document = self.generate(schema) if document is None else document
            for _ in range(draw.choice([0, 0, 1, 1, 2])):
                document = self.damage(document)
            body = json.dumps(document).encode()
            if draw.random() < 0.05:
                body = self._tear(body)
        arguments["content"] = body
        arguments["headers"]["content-type"] = kind

    def _choose_document(self, path: str) -> Any:
        """Choose a valid body for a path; None if there is none at hand."""
        draw = self._draw
        names = self.pool["dataset_id"][-5:] or ["steps"]
        run = draw.choice(self.pool["run_id"] or ["run_x"])
        model = draw.choice(["fopdt", "sopdt", OWN_MODEL, {**OWN_MODEL, "equations": {"x": "u"}}])
        job = {
            "model": model,
            "datasets": [draw.choice(names)],
            "channels": {"u": "u", "y": "y"},
            "algorithm": SMALL_SEARCH,
            "seed": draw.randrange(5),
        }
        axes = [{"path": "/seed", "values": [1, 2]}, {"path": "/noise/sigma", "range": [0, 0.1, 2]}]
        bodies: dict[str, list[Any]] = {
            "/v1/jobs": [job, {**job, "sweep": {"axes": axes[: draw.randint(1, 2)]}}],
            "/v1/datasets:simulate": [{"model": "fopdt", **TRUTH}, {"model": OWN_MODEL, **TRUTH}],
            "/v1/models": [self._make_model()],
            "/v1/models:check": [self._make_model()],
            "/v1/recipes/noise-sweep": [{"model": "fopdt", "truth": TRUTH, "sigma": [0.1]}],
            "/v1/recipes/reidentify": [
                {
                    "model": "fopdt",
                    "label": "n",
                    "trend_parameters": ["L"],
                    "batch": [{"x": 1, "datasets": [draw.choice(names)]}],
                }
            ],
            "/v1/datasets/{dataset_id}:derive": [
                {"steps": [{"trim": {"start": 1, "stop": 9}}]},
                {"steps": [{"noise": {"sigma": 0.1, "channels": ["y"]}}, {"resample": 0.2}]},
            ],
            "/v1/runs:compare": [{"runs": self.pool["run_id"][-2:]}],
            "/v1/runs/{run_id}:simulate": [
                {"inputs": {"u": {"kind": "step"}}, "samples": 50, "sample_time": 0.1},
                {"inputs": {"u": {"kind": "expression", "expression": "sin(t)"}}, "samples": 9},
            ],
            "/v1/runs/{run_id}:validate": [{"dataset": draw.choice(names)}],
            "/v1/runs/{run_id}:profile": [{"parameter": "L"}],
            "/v1/references/{name}": [{"run": run, "note": "n"}],
        }
        return copy.deepcopy(draw.choice(bodies.get(path, [None])))

    def _make_model(self) -> dict[str, Any]:
        model = copy.deepcopy(OWN_MODEL)
        model["name"] = self._draw.choice(["own", "tank", f"m{self._draw.randrange(50)}"])
        if self._draw.random() < 0.6:
            model["equations"]["x"] = self._draw.choice(EQUATIONS)
        if self._draw.random() < 0.6:
            model["let"] = copy.deepcopy(self._draw.choice(NAMES_OF_LET))
        if self._draw.random() < 0.2:
            states = [f"s{n}" for n in range(self._draw.choice([3, 12, 64]))]
            tie = " + ".join(f"{name}*L" for name in states[:12])
            model |= {"states": dict.fromkeys(states, "m"), "outputs": {"y": states[0]}}
            model["equations"] = {name: f"{n}*{tie} - {name}*T" for n, name in enumerate(states)}
            model["initial"] = dict.fromkeys(states, self._draw.choice(["steady", 0, "L*u0"]))
        return model

    def make_file(self, kind: str) -> bytes:
        """Make a recording, whole or torn."""
        draw = self._draw
        with tempfile.TemporaryDirectory() as folder:
            good = paper_example.write_csv(Path(folder) / "a.csv", seed=draw.randrange(3))
            body = good.read_bytes()
        rows = [f"{0.1 * k:.1f},{k % 7 // 3},{k % 5}" for k in range(draw.choice([0, 2, 120]))]
        own = "\n".join(["t,u,y", *rows]).encode()
        body = draw.choice([body, own, own, b"", b"\x89MCAP0\r\n" + own, b"t,=1+1\n0,1\n1,2\n"])
        if kind == MCAP and draw.random() < 0.5:
            body = b"\x89MCAP0\r\n" + draw.randbytes(draw.randrange(400)) + b"\x89MCAP0\r\n"
        return self._tear(body) if draw.random() < 0.5 else body

    def _tear(self, body: bytes) -> bytes:
        draw, torn = self._draw, bytearray(body)
        for _ in range(draw.randint(1, 6)):
            place = draw.randrange(len(torn) + 1)
            torn[place : place + draw.choice([0, 1, 50])] = draw.choice(
                [b"", b"\x00", b"nan", b"1e999", b",,,", b'"', b"\xff\xfe", b"\r", b"9" * 400]
            )
        return bytes(torn)

    def _damage_head(self, arguments: dict[str, Any]) -> None:
        draw, headers = self._draw, arguments["headers"]
        match draw.randrange(7):
            case 0:
                headers["host"] = draw.choice(HOSTS)
            case 1:
                headers["origin"] = draw.choice(["null", "http://evil.example", "", "x", FOREIGN])
            case 2:
                headers["sec-fetch-site"] = draw.choice(["cross-site", "none", "zzz"])
            case 3:
                headers["content-type"] = draw.choice(
                    ["", "text/plain", "x", JSON, YAML, CSV, FOREIGN]
                )
            case 4:
                headers["range"] = draw.choice(
                    ["bytes=0-1", f"bytes=0-{'9' * 5000}", "bytes=-", "x"]
                )
            case 5:
                headers["if-none-match"] = headers["if-match"] = draw.choice(ETAGS)
            case 6:
                headers["accept"] = draw.choice(["text/html", "*/*;q=x", "", "application/yaml"])

    def damage(self, document: Any) -> Any:
        """Put another value at some place of a document."""
        places = list(_walk(document))
        if not places:
            return self._make_value()
        *above, last = self._draw.choice(places)
        changed = copy.deepcopy(document)
        holder = changed
        for key in above:
            holder = holder[key]
        holder[last] = self._make_value()
        return changed

    def _make_value(self, depth: int = 0) -> Any:
        draw = self._draw
        kind = draw.randrange(7 if depth < 2 else 4)
        match kind:
            case 0:
                return draw.choice([None, True, False])
            case 1:
                return draw.choice(NUMBERS)
            case 2 | 3:
                known = [value for values in self.pool.values() for value in values[-3:]]
                return draw.choice([*NAMES, *known, *EQUATIONS])
            case 4 | 5:
                return [self._make_value(depth + 1) for _ in range(draw.randrange(3))]
        names = ["u", "y", "L", *NAMES[:4]]
        return {draw.choice(names): self._make_value(depth + 1) for _ in range(draw.randrange(3))}

    def generate(self, schema: dict[str, Any], depth: int = 0) -> Any:
        """Generate a value that a schema allows, mostly."""
        draw = self._draw
        if "$ref" in schema:
            name = schema["$ref"].rpartition("/")[2]
            return self.generate(self._schema["components"]["schemas"][name], depth + 1)
        for several in ("anyOf", "oneOf"):
            if several in schema:
                return self.generate(draw.choice(schema[several]), depth + 1)
        if "enum" in schema or "const" in schema:
            return draw.choice(schema.get("enum", [schema.get("const")]))
        return self._generate_plain(schema, depth)

    def _generate_plain(self, schema: dict[str, Any], depth: int) -> Any:
        draw = self._draw
        match schema.get("type"):
            case "object":
                return self._generate_object(schema, depth)
            case "array":
                count = draw.randint(schema.get("minItems", 0), 3) if depth < 6 else 0
                return [self.generate(schema.get("items", {}), depth + 1) for _ in range(count)]
            case "integer" | "number" as kind:
                low = schema.get("minimum", schema.get("exclusiveMinimum", -3))
                high = schema.get("maximum", schema.get("exclusiveMaximum", low + 300))
                value = draw.choice([low, high, draw.uniform(low, min(high, low + 300))])
                return round(value) if kind == "integer" else value
            case "boolean":
                return draw.random() < 0.5
            case "string":
                known = [value for values in self.pool.values() for value in values[-3:]]
                return draw.choice(["fopdt", "u", "y", "L", "/seed", *known, *NAMES])
            case "null":
                return None
        return self._make_value()

    def _generate_object(self, schema: dict[str, Any], depth: int) -> dict[str, Any]:
        draw, required = self._draw, schema.get("required", [])
        properties = schema.get("properties", {})
        value = {
            name: self.generate(inner, depth + 1)
            for name, inner in properties.items()
            if name in required or (depth < 6 and draw.random() < 0.3)
        }
        more = schema.get("additionalProperties")
        if isinstance(more, dict) and depth < 6:
            value |= {name: self.generate(more, depth + 1) for name in draw.sample("uyLKT", 1)}
        return value


def _to_text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text.encode("utf-8", "replace").decode()


def _walk(node: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(node, dict):
        entries: list[tuple[Any, Any]] = list(node.items())
    elif isinstance(node, list):
        entries = list(enumerate(node))
    else:
        return
    for key, value in entries:
        yield (*here, key)
        yield from _walk(value, (*here, key))


def _ask(
    client: httpx.Client, method: str, path: str, arguments: dict[str, Any]
) -> tuple[httpx.Response, bytes]:
    if not path.endswith("/events"):
        answer = client.request(method, **arguments)
        return answer, answer.content
    with client.stream(method, **arguments) as stream:  # it has no end
        return stream, b"" if stream.status_code == httpx.codes.OK else stream.read()


class Fuzzer:
    """Senders of random requests, and the counts of what they got."""

    def __init__(self, url: str, seed: int) -> None:
        self._url, self.outcome, self._lock = url, Outcome(), threading.Lock()
        self._schema = httpx.get(f"{url}/openapi.json", timeout=60).json()
        self._seed = seed

    def run(self, minutes: float, senders: int = 2) -> None:
        """Send requests for some minutes."""
        until = time.monotonic() + 60 * minutes
        threads = [
            threading.Thread(target=self._send_until, args=(until, self._seed * 100 + number))
            for number in range(senders)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _send_until(self, until: float, seed: int) -> None:
        requests = Requests(self._schema, random.Random(seed))
        with httpx.Client(base_url=self._url, timeout=httpx.Timeout(120.0)) as client:
            while time.monotonic() < until:
                self._send(client, requests)

    def _send(self, client: httpx.Client, requests: Requests) -> None:
        method, path, arguments, operation = requests.make()
        begun = time.monotonic()
        try:
            try:
                answer, body = _ask(client, method, path, arguments)
            except (httpx.ReadError, httpx.RemoteProtocolError):  # it closed an idle connection
                answer, body = _ask(client, method, path, arguments)
        except (httpx.InvalidURL, httpx.LocalProtocolError, UnicodeEncodeError):
            return  # httpx does not send such a request
        except httpx.HTTPError as error:
            self._note_fault(f"{method} {path}: {type(error).__name__}", arguments, b"")
            return
        took = time.monotonic() - begun
        self._count(method, path, operation, arguments, answer, body, took)
        if answer.is_success and answer.headers.get("content-type", "").startswith(JSON):
            requests.remember(json.loads(body))

    def _count(
        self,
        method: str,
        path: str,
        operation: dict[str, Any],
        arguments: dict[str, Any],
        answer: httpx.Response,
        body: bytes,
        took: float,
    ) -> None:
        status, name = answer.status_code, f"{method} {path}"
        is_busy = status == httpx.codes.SERVICE_UNAVAILABLE and "retry-after" in answer.headers
        with self._lock:
            outcome = self.outcome
            outcome.by_status[status] += 1
            outcome.operations.add(name)
            kind = "body" if "content" in arguments else "query" if arguments["params"] else "path"
            outcome.kinds[kind] += 1
            outcome.slowest = max(outcome.slowest, (took, name))
            documented = operation.get("responses", {})
            is_open = not documented or name == "get /readyz"
            if not is_open and str(status) not in documented and status >= 400:
                outcome.undocumented.add(f"{name}: {status}")
        if status >= 500 and not is_busy and name != "get /readyz":
            self._note_fault(f"{name}: {status}", arguments, body)

    def _note_fault(self, kind: str, arguments: dict[str, Any], body: bytes) -> None:
        with self._lock:
            if kind not in self.outcome.faults:
                self.outcome.faults[kind] = f"{arguments!r:.1500} -> {body[:300]!r}"
                print(f"{kind}: {self.outcome.faults[kind]}", flush=True)


def make_rows(outcome: Outcome, minutes: float) -> list[Row]:
    """Make the figures of a table."""
    rows = [
        Row("requests", sum(outcome.by_status.values()), "", 500, ">="),
        Row("operations", len(outcome.operations), ""),
        Row("minutes", minutes, "min"),
        *(Row(f"status {status}", n, "") for status, n in sorted(outcome.by_status.items())),
        *(Row(f"requests with a {kind}", n, "") for kind, n in sorted(outcome.kinds.items())),
        Row("kinds of 5xx, or of lost connections", len(outcome.faults), "", 0),
        Row("statuses that OpenAPI does not have", len(outcome.undocumented), "", 0),
        Row(f"slowest answer ({outcome.slowest[1]})", outcome.slowest[0], "s"),
    ]
    return rows


def main() -> None:
    """Fuzz a service of its own and print the table."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--minutes", type=float, default=30.0)
    arguments.add_argument("--seed", type=int, default=1)
    options = arguments.parse_args()
    minutes = 1.0 if options.quick else options.minutes
    with (
        tempfile.TemporaryDirectory(prefix="lagid-fuzz-") as folder,
        standing_service(Stand(Path(folder) / "data")) as stand,
    ):
        fuzzer = Fuzzer(stand.url, options.seed)
        fuzzer.run(minutes)
        is_alive = stand.answers() == httpx.codes.OK
    for name in sorted(fuzzer.outcome.undocumented):
        print(f"not in OpenAPI: {name}")
    rows = make_rows(fuzzer.outcome, minutes)
    rows.append(Row("service answers afterwards", float(is_alive), "", 1, ">="))
    report(f"Fuzzing, seed {options.seed}", rows, [], options)


if __name__ == "__main__":
    main()
