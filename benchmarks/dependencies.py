"""Licences and known vulnerabilities of the libraries that lagid is installed with.

Licences come from the metadata of installed packages. Vulnerabilities come from `pip-audit`, which
asks a public database. Where it is not installed or reaches nobody, the table says so.
"""

import json
import re
import subprocess
import sys
from email.message import Message
from importlib.metadata import PackageNotFoundError, distribution, metadata
from typing import Any, cast

from benchmarks.table import Row, Skipped, parser, report
from tests.support.checkout import ROOT

LOCK = ROOT / "requirements.lock"
PERMISSIVE = r"\b(MIT|BSD|Apache|ISC|PSF|MPL|Mozilla)\b"
LINKED_FREELY = ("psycopg", "psycopg-binary")
"""Under the LGPL, which lets any program import them."""
AUDIT_SECONDS = 600.0


def list_locked() -> list[str]:
    """List the names of the locked packages."""
    return re.findall(r"^([A-Za-z0-9_.-]+)==", LOCK.read_text(), re.MULTILINE)


def list_licences(package: Message) -> list[str]:
    """List what a package says about its licence: expression, first line of a text, classifiers."""
    classifiers = [text for text in package.get_all("Classifier", []) if text.startswith("License")]
    written = [package.get("License-Expression", ""), package.get("License", "").split("\n")[0]]
    return [text for text in (*written, *classifiers) if text]


def read_licence_file(name: str) -> list[str]:
    """Read the first line of the licence file of a package that says nothing else."""
    text = distribution(name).read_text("licenses/LICENSE") or ""
    return text.strip().split("\n")[:1]


def find_licence_faults(names: list[str]) -> tuple[list[str], list[str]]:
    """Find packages without a permissive licence, and packages that are not installed here."""
    faults, absent = [], []
    for name in names:
        try:
            licences = list_licences(cast("Message", metadata(name))) or read_licence_file(name)
        except PackageNotFoundError:
            absent.append(name)
            continue
        is_permissive = any(re.search(PERMISSIVE, text) for text in licences)
        if not is_permissive and name not in LINKED_FREELY:
            faults.append(f"{name}: {licences[0] if licences else 'no licence'}")
    return faults, absent


def audit_packages() -> list[str] | str:
    """List known vulnerabilities; a text if the audit was not possible."""
    command = ["-m", "pip_audit", "--requirement", str(LOCK), "--disable-pip", "--require-hashes"]
    try:
        done = subprocess.run(
            [sys.executable, *command, "--format", "json", "--progress-spinner", "off"],
            capture_output=True,
            text=True,
            timeout=AUDIT_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"not reached: no answer within {AUDIT_SECONDS:g} s"
    return read_audit(done.stdout, done.stderr)


def read_audit(output: str, errors: str) -> list[str] | str:
    """Read the answer of `pip-audit`; a text if there is none."""
    try:
        packages: list[dict[str, Any]] = json.loads(output)["dependencies"]
    except (ValueError, KeyError, TypeError):
        if "No module named" in errors:
            return "not reached: pip install -r benchmarks/requirements-night.txt"
        return f"not reached: {(errors.strip().splitlines() or ['no answer'])[-1][:200]}"
    return [
        f"{package['name']} {package.get('version', '')}: {entry['id']}"
        for package in packages
        for entry in package.get("vulns", [])
    ]


def main() -> None:
    """Look at the locked packages and print the table."""
    options = parser(__doc__ or "").parse_args()
    names = list_locked()
    faults, absent = find_licence_faults(names)
    rows = [
        Row("locked packages", len(names), "", 1, ">="),
        Row("packages without a permissive licence", len(faults), "", 0),
        Row("packages of other systems, not looked at", len(absent), ""),
    ]
    skipped = []
    found = audit_packages()
    if isinstance(found, str):
        skipped.append(Skipped("known vulnerabilities", found))
    else:
        rows.append(Row("known vulnerabilities", len(found), "", 0))
        faults += found
    for fault in faults:
        print(fault)
    report("Libraries", rows, skipped, options)


if __name__ == "__main__":
    main()
