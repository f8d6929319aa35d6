"""Photographs of pages of a service: ``python -m tests.documents.photographs`` takes them again.

Each page is made by real commands, as a user gives them: a job of two time constants, and two
batches of tubes, of which one has changed.
"""

import json
import os
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from lagid import Channel, Client, simulate
from tests.documents.painter import CHROMIUM
from tests.documents.tutorials import Shell
from tests.support.checkout import ROOT

PICTURES = ROOT / "docs"
SERVE = "lagid serve --data-dir data &"
LENGTHS = (5, 10, 20, 40, 80)
JOB = {
    "name": "heating, two time constants",
    "model": "sopdt",
    "datasets": ["heating"],
    "channels": {"u": "u", "y": "y"},
    "validation": {"fraction": 0.3},
}


def write_heating(path: Path) -> None:
    """Write a recording of an oven of two time constants, moved every 100 s."""
    t = np.arange(900.0)
    levels = np.array([20.0, 60.0, 30.0, 80.0, 50.0, 10.0, 70.0, 40.0, 90.0])
    u = levels[(t // 100).astype(int)]
    true = {"K": 0.8, "T1": 40.0, "r": 0.35, "L": 11.5, "y0": 20.0, "w(0)": 16.0, "x(0)": 16.0}
    y = simulate("sopdt", Channel("u", t, u, hold="zero"), true)["y"].values
    y += np.random.default_rng(8).normal(0, 0.15, t.size)
    table = np.column_stack([t, u, y.round(3)])
    np.savetxt(path, table, "%g", ",", header="t [s],u [%],y [°C]", comments="", encoding="utf-8")


def submit_heating(shell: Shell) -> str:
    """Identify the oven; return the job."""
    write_heating(Path("heating.csv"))
    Path("job.json").write_text(json.dumps(JOB), encoding="utf-8")
    shell.run("lagid dataset add heating.csv")
    shell.run("lagid submit job.json --wait --quiet")
    return find_last_job()


def submit_batches(shell: Shell) -> str:
    """Identify five tubes, and weeks later again: that of 20 m has another bore; return the job."""
    for length in LENGTHS:
        changed = " --set bore_m=0.006" if length == 20 else ""
        simulated = f"lagid dataset simulate --plant tube --set length_m={length}"
        shell.run(f"{simulated} --name tube-{length}m")
        shell.run(f"{simulated} --name new-{length}m --set pattern=2{changed}")
    batch = "lagid reidentify --model tube --label length_m --channels u=P1,y=P2 --parameters T,L"
    tubes, again = (
        " ".join(f"{length}={name}-{length}m" for length in LENGTHS) for name in ("tube", "new")
    )
    accept = "--predict 30 --wait --accept tube --accept-run 40"
    shell.run(f"{batch} {tubes} {accept}")
    shell.run(f"{batch} {again} --reference tube --wait")
    return find_last_job()


def find_last_job() -> str:
    """Find the job that was submitted last."""
    with Client(os.environ["LAGID_URL"]) as client:
        return str(client.jobs()[0]["id"])


def photograph(browser: Browser, name: str, path: str, first: str = "", last: str = "") -> None:
    """Photograph what a window shows of a page, or from one part to the end of another."""
    page = browser.new_page(viewport={"width": 1280, "height": 925})
    page.goto(f"{os.environ['LAGID_URL']}{path}")
    page.wait_for_selector(f"{first} .plot .main-svg")
    page.wait_for_load_state("networkidle")
    if not first:
        page.screenshot(path=PICTURES / name)
    else:
        begin, end = (page.locator(part).first.bounding_box() for part in (first, last))
        assert begin is not None
        assert end is not None
        begin["height"] = end["y"] + end["height"] - begin["y"]
        page.screenshot(path=PICTURES / name, full_page=True, clip=begin)
    page.close()


def main() -> None:
    """Make the jobs in an empty folder, and photograph their pages."""
    with TemporaryDirectory(prefix="lagid-") as folder, chdir(folder), Shell() as shell:
        shell.run(SERVE)
        oven, batch = submit_heating(shell), submit_batches(shell)
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM)
            photograph(browser, "job-page.png", f"/jobs/{oven}")
            photograph(browser, "trend.png", f"/jobs/{batch}", "#trend", "#trend table")
            browser.close()


if __name__ == "__main__":
    main()
