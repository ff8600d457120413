"""The installed service under a systemd of its own: run.py ROOT PACKAGE, as root.

Boots the minimal Debian in ROOT as a container whose changes are forgotten, installs PACKAGE in it and looks: readiness, a
scan, restarts after a kill and after a hang, graceful stops, the sandbox, the log, removal. Prints a line per check; the
exit status is 1 if any failed.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "python"))
import small_twin  # noqa: E402

URL = "http://127.0.0.1:8631"
# Generous: machines that test are busy.
PATIENCE = 90
OUTSIDE = "192.0.2.1"
failures = []


def check(good, text, seen=""):
    print(f"  {'ok' if good else 'FAILED'}: {text}" + (f" ({seen})" if seen != "" else ""), flush=True)
    if not good:
        failures.append(text)


def until(reached, what, patience=PATIENCE):
    """Seconds until `reached` holds; the test ends where it never does."""
    start = time.monotonic()
    while not reached():
        if time.monotonic() - start > patience:
            raise Broken(f"{what}: not within {patience} s")
        time.sleep(0.1)
    return time.monotonic() - start


class Broken(Exception):
    """What follows would mean nothing."""


class Container:
    def __init__(self, root, shared):
        self.log = open(shared / "console", "wb")
        command = ["systemd-nspawn", "--quiet", "-D", root, "--boot", "--volatile=overlay", "--register=no", "--keep-unit",
                   "--private-network", "--machine=polscan-test", "--console=pipe", f"--bind-ro={shared}:/shared",
                   # The systemd inside filters addresses by programs of the kernel.
                   "--capability=CAP_BPF", "--system-call-filter=bpf"]
        # The unified hierarchy is what filters of addresses and devices need; a machine may have it beside the old ones.
        environment = {**os.environ, "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"}
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=self.log, stderr=self.log, env=environment)
        self.leader = None
        self.console = shared / "console"

    def boot(self):
        def running():
            if self.process.poll() is not None:
                raise Broken(f"the container ended:\n{self.console.read_text(errors='replace')[-3000:]}")
            children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
            self.leader = children[0] if children else None
            return self.leader and self.run("systemctl", "is-system-running").stdout.strip() in ("running", "degraded")

        return until(running, "the container boots")

    def run(self, *command, namespaces="-a"):
        command = ["nsenter", "-t", self.leader, namespaces, "--", *map(str, command)]
        return subprocess.run(command, capture_output=True, text=True, timeout=180)

    def shell(self, script):
        done = self.run("sh", "-ec", script)
        if done.returncode != 0:
            raise Broken(f"{script}: {done.stdout}{done.stderr}")
        return done.stdout

    def show(self, *names, unit="polscan"):
        said = self.shell(f"systemctl show {unit} " + " ".join(f"-p {name}" for name in names))
        pairs = dict(line.split("=", 1) for line in said.splitlines() if "=" in line)
        values = [pairs.get(name, "") for name in names]
        return values if len(values) > 1 else values[0]

    def ask(self, method, path, body=None):
        """Status and body of an answer; status 0 where there is none."""
        data = ["-H", "Content-Type: application/json", "-d", json.dumps(body)] if body is not None else []
        done = self.run("curl", "-sS", "-m", "120", "-X", method, *data, "-w", r"\n%{http_code}", URL + path)
        text, _, status = done.stdout.rpartition("\n")
        return int(status or 0), text

    def scan(self, body, wait=""):
        status, text = self.ask("POST", f"/v1/scans{wait}", body)
        if status != 202:
            raise Broken(f"no scan: {status} {text}")
        return json.loads(text)

    def state(self, identity):
        status, text = self.ask("GET", f"/v1/scans/{identity}")
        return json.loads(text)["state"] if status == 200 else f"status {status}"

    def ready(self):
        return until(lambda: self.ask("GET", "/readyz")[0] == 200, "the rig opens")

    def journal(self, *more):
        return self.run("journalctl", "-u", "polscan", "--no-pager", "-o", "short-precise", *more).stdout

    def end(self):
        if self.process.poll() is None:
            # Asks the systemd inside to end; then it is ended.
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self.log.close()


def install(box, shared):
    print("package:")
    done = box.run("dpkg", "-i", "/shared/polscan.deb")
    check(done.returncode == 0, "dpkg -i installs it", (done.stdout + done.stderr).strip()[-200:] if done.returncode else "")
    check(box.show("LoadState", "UnitFileState") == ["loaded", "disabled"], "the unit is known, and not started by itself",
          "/".join(box.show("LoadState", "UnitFileState")))
    check("polscan" in box.shell("getent passwd polscan"), "the user polscan is there")
    mode = box.shell("stat -c '%a %U %G' /etc/polscan /etc/polscan/polscan.toml").split("\n")[:2]
    check(mode == ["750 root polscan", "640 root polscan"], "configuration is for root and the service", ", ".join(mode))
    verified = box.run("systemd-analyze", "verify", "/usr/lib/systemd/system/polscan.service")
    check(verified.returncode == 0, "systemd-analyze verify finds nothing", verified.stderr.strip()[:300])
    box.shell("cp -r /shared/twin/. /etc/polscan/ && chown -R root:polscan /etc/polscan && chmod -R u+rwX,g+rX,o= /etc/polscan")


def readiness(box):
    print("start:")
    start = time.monotonic()
    # Enabled, so that systemd keeps in mind how it ended.
    box.shell("systemctl enable --quiet --now polscan")
    took = time.monotonic() - start
    status, _ = box.ask("GET", "/livez")
    # `start` of a unit of type notify returns with READY=1 and not before.
    check(status == 200, "the interface answers as soon as systemctl enable --now returns", f"{took:.1f} s")
    check(box.show("Type", "ActiveState", "SubState") == ["notify", "active", "running"], "the unit is active")
    check(box.show("Environment") == "", "the unit sets no variable, so that no rig hangs on demand")
    box.ready()
    scan = box.scan({"label": "first"}, "?wait=done")
    check(scan["state"] == "done", "a scan runs over REST", scan["state"])
    identity = scan["id"]
    owner = box.shell(f"stat -c %U /var/lib/polscan/scans/{identity}").strip()
    check(owner == "polscan", "its bundle is the service's", owner)
    until(lambda: box.show("StatusText") == "idle", "STATUS says idle")
    check(True, "STATUS is told to systemd", box.show("StatusText"))
    before = box.show("MainPID")
    box.shell("systemctl reload polscan")
    status, _ = box.ask("GET", "/livez")
    check(box.show("MainPID") == before and status == 200, "a reload reads tokens and certificate again, and goes on")
    return identity


def sandbox(box):
    print("sandbox:")
    judged = box.run("systemd-analyze", "security", "--no-pager", "--threshold=25", "polscan.service")
    overall = (re.findall(r"Overall exposure level.*?: ([\d.]+) (\w+)", judged.stdout) or [("none", "")])[0]
    check(judged.returncode == 0 and overall[1] == "OK", "systemd-analyze security: at most 2.5 and OK", " ".join(overall))
    main = box.show("MainPID")
    status = dict(line.split(":", 1) for line in box.shell(f"cat /proc/{main}/status").splitlines() if ":" in line)
    held = {name: status[name].strip() for name in ("NoNewPrivs", "Seccomp", "CapEff", "CapBnd")}
    right = held == {"NoNewPrivs": "1", "Seccomp": "2", "CapEff": "0" * 16, "CapBnd": "0" * 16}
    check(right and status["Uid"].split()[0] != "0", "the process is no root, has no capability, and a filter of calls", held)

    # The unit as it is installed, with another program in it.
    box.shell("""
        sed -e 's|^ExecStart=.*|ExecStart=/usr/bin/perl /opt/probe.pl /var/lib/polscan/probe 8632|' \\
            -e 's|^Type=notify|Type=oneshot|' -e '/^NotifyAccess/d' -e '/^Watchdog/d' -e '/^Restart/d' \\
            /usr/lib/systemd/system/polscan.service >/run/systemd/system/polscan-probe.service
        mkdir -p /opt /home/somebody && cp /shared/probe.pl /opt/probe.pl && touch /tmp/polscan-outside /home/somebody/letter
        systemctl daemon-reload""")
    link = box.run("true")  # Its loopback device gets an address that is not loopback.
    address = subprocess.run(["nsenter", "-t", box.leader, "-n", "--", "ip", "address", "add", f"{OUTSIDE}/32", "dev", "lo"],
                             capture_output=True, text=True)
    if link.returncode or address.returncode:
        raise Broken(f"no address to reach: {address.stderr}")
    listen = ("use Socket; socket(S, PF_INET, SOCK_STREAM, 0); setsockopt(S, SOL_SOCKET, SO_REUSEADDR, 1);"
              "bind(S, sockaddr_in(8632, INADDR_ANY)) or die; listen(S, 9); accept(C, S) while 1")
    listener = subprocess.Popen(["nsenter", "-t", box.leader, "-a", "--", "perl", "-e", listen])
    try:
        reach = f"exec 3<>/dev/tcp/{OUTSIDE}/8632"
        until(lambda: box.run("bash", "-c", reach).returncode == 0, "the address is reached without the sandbox", 20)
        done = box.run("systemctl", "start", "polscan-probe")
        if done.returncode:
            raise Broken(f"the probe: {done.stderr}\n{box.run('journalctl', '-u', 'polscan-probe', '--no-pager').stdout}")
    finally:
        listener.kill()
        listener.wait()
    found = dict(line.split(" ", 1) for line in box.shell("cat /var/lib/polscan/probe").splitlines())
    written = sorted(name[6:] for name, result in found.items() if name.startswith("write:") and result == "done")
    check(written == ["/run/polscan", "/tmp", "/var/lib/polscan"], "it writes to its own folders, of all that were tried, only",
          ", ".join(written))
    check(found["see:/tmp"] == "own", "its /tmp is its own")
    for folder in ("/home", "/root"):
        check(found[f"see:{folder}"] == "nothing", f"it sees nothing in {folder}", found[f"see:{folder}"])
    check(found["see:processes"] == "own", "it sees no process of others", found["see:processes"])
    check(found["read:/etc/shadow"] in ("EACCES", "EPERM"), "it cannot read /etc/shadow", found["read:/etc/shadow"])
    check(found["user"] == "polscan", "it is polscan", found["user"])
    check(found["connect:loopback"] == "done", "it reaches its own machine", found["connect:loopback"])
    check(found["connect:outside"] in ("EPERM", "EACCES", "late"), f"it does not reach {OUTSIDE}, which others do",
          found["connect:outside"])
    for name in ("socket:packet", "socket:bluetooth"):
        check(found[name] == "EAFNOSUPPORT", f"no {name.split(':')[1]} sockets", found[name])
    for name in ("mount", "unshare", "sethostname", "write-and-execute"):
        check(found[f"call:{name}"] in ("EPERM", "EACCES"), f"no {name}", found[f"call:{name}"])


def killed(box, first):
    print("kill -9:")
    before, main = int(box.show("NRestarts")), box.show("MainPID")
    box.shell(f"kill -9 {main}")
    took = until(lambda: int(box.show("NRestarts")) > before and box.show("ActiveState") == "active", "Restart= starts it again")
    check(box.show("MainPID") not in ("0", main), "Restart= starts it again", f"{took:.1f} s")
    check(box.ask("GET", "/livez")[0] == 200 and box.state(first) == "done", "it answers, and knows the finished scan")


def hangs(box):
    print("a rig that hangs:")
    # Six seconds instead of sixty, so that nobody waits for two minutes.
    box.shell("""
        mkdir -p /run/systemd/system/polscan.service.d
        printf '[Service]\\nEnvironment=POLSCAN_TEST_STALL=hang\\nWatchdogSec=6\\n' >/run/systemd/system/polscan.service.d/test.conf
        systemctl daemon-reload && systemctl restart polscan""")
    check(box.show("TimeoutAbortUSec") == "10s", "TimeoutAbortSec= is the unit's own", box.show("TimeoutAbortUSec"))
    box.ready()
    before, main = int(box.show("NRestarts")), box.show("MainPID")
    identity = box.scan({"label": "hang"})["id"]
    check(box.ask("GET", "/livez")[0] == 200, "the interface answers while the rig hangs")
    took = until(lambda: int(box.show("NRestarts")) > before and box.show("ActiveState") == "active", "the watchdog restarts it")
    check(box.show("MainPID") not in ("0", main), "the watchdog restarts it", f"{took:.1f} s with WatchdogSec=6")
    log = box.journal()
    check("Watchdog timeout" in log and "watchdog" in log, "systemd says that it was the watchdog")
    check("gives no sign of life" in log, "the service has said why")
    state = box.state(identity)
    check(state == "interrupted", "the scan that hung is interrupted", state)
    box.ready()
    box.shell("rm -r /run/systemd/system/polscan.service.d && systemctl daemon-reload && systemctl restart polscan")
    box.ready()


def stop_while_scanning(box, body):
    """Seconds and what became of unit and scan."""
    identity = box.scan(body)["id"]
    until(lambda: box.state(identity) == "projecting", "the scan runs")
    until(lambda: f"scanning {identity}" in box.show("StatusText"), "STATUS names the scan")
    start = time.monotonic()
    box.shell("systemctl stop polscan")
    took = time.monotonic() - start
    unit = box.show("ActiveState", "Result", "ExecMainCode", "ExecMainStatus")
    box.shell("systemctl start polscan")
    return took, unit, box.state(identity)


def stops(box):
    print("stop:")
    ended = ["inactive", "success", "1", "0"]
    took, unit, state = stop_while_scanning(box, {"mode": "fast"})
    check(unit == ended, "a stop during a scan ends with exit status 0", "/".join(unit))
    check(state == "done", "the scan came to its end first", f"{state}, {took:.1f} s")
    box.ready()
    # 48 frames of 2 seconds each would take longer than the service has.
    took, unit, state = stop_while_scanning(box, {"mode": "pse", "exposure_us": 2e6})
    check(unit == ended and took < 45, "a stop during a scan that is too long ends with exit status 0, in time",
          f"{'/'.join(unit)}, {took:.1f} s of 45")
    check(state == "interrupted", "that scan was cut short, and says so", state)
    box.ready()
    check("State 'stop-sigterm' timed out" not in box.journal(), "nothing had to be killed")


def logs(box, first):
    print("log:")
    log = box.journal()
    check("serving" in log and first in log, "the journal has the start and the scan", f"{len(log.splitlines())} lines")
    check("panicked" not in log, "nothing panicked")


def remove(box, first):
    print("removal:")
    done = box.run("dpkg", "-r", "polscan")
    check(done.returncode == 0, "dpkg -r removes it", done.stderr.strip()[-200:])
    check(box.ask("GET", "/livez")[0] == 0 and box.show("ActiveState") != "active", "the service has ended")
    gone = box.run("sh", "-c", "ls /usr/bin/polscan /usr/lib/systemd/system/polscan.service /usr/lib/sysusers.d/polscan.conf")
    check(gone.stdout == "", "program and unit are gone", gone.stdout)
    kept = box.run("cat", "/etc/polscan/polscan.toml")
    check(kept.returncode == 0, "the configuration stays")
    done = box.run("dpkg", "-P", "polscan")
    check(done.returncode == 0, "dpkg -P purges it", done.stderr.strip()[-200:])
    check(box.run("test", "-e", "/etc/polscan").returncode != 0, "the configuration is gone")
    check(box.run("test", "-e", f"/var/lib/polscan/scans/{first}/report.json").returncode == 0, "scans stay: they are measurements")


def main(root, package):
    for program in ("systemd-nspawn", "nsenter", "ip"):
        if not shutil.which(program):
            raise SystemExit(f"{program} is missing: scripts/install systemd brings it")
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="polscan-systemd-") as folder:
        shared = Path(folder)
        shared.chmod(0o755)
        shutil.copy(package, shared / "polscan.deb")
        shutil.copy(HERE / "probe.pl", shared)
        small_twin.write(shared / "twin", 8.0, [("sim.pacing", '"real-time"'), ("store.min_free_gib", "0.0")])
        box = Container(root, shared)
        try:
            print(f"container: booted in {box.boot():.1f} s, load {os.getloadavg()[0]:.1f}", flush=True)
            install(box, shared)
            first = readiness(box)
            sandbox(box)
            killed(box, first)
            hangs(box)
            stops(box)
            logs(box, first)
            remove(box, first)
        except (Broken, subprocess.TimeoutExpired) as error:
            check(False, str(error))
            if box.leader and box.process.poll() is None:
                print(box.run("systemctl", "status", "--no-pager", "polscan").stdout, box.journal("-n", "60"))
        finally:
            box.end()
    print(f"{time.monotonic() - start:.0f} s, {len(failures)} failed")
    return 1 if failures else 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    sys.exit(main(sys.argv[1], sys.argv[2]))
