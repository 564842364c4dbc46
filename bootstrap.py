"""The script that makes .venv with the pinned requirements.

`make .venv` runs it with any Python.

With the argument `sweeps` it adds the packages for sweeps on clusters and for trackers, with
`jax-envs` the environments that live in JAX; the tests need both. `docs` adds what builds the
manual.

Old versions of Python must be able to parse this file, so that it can report that they are too old.
"""

import os
import platform
import subprocess
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
VENV = os.path.join(HERE, ".venv")
LOG = os.path.join(HERE, ".venv", "install.log")


def stop(message):
    """Print an error message and exit with status 2."""
    sys.stderr.write("sndjax: %s\n" % message)
    sys.exit(2)


def check_platform():
    """Exit with an error if the Python version or the platform is not supported."""
    if sys.version_info < (3, 11):
        stop(
            "needs Python 3.11 or newer, and %s is %s; install one and run: make PYTHON=python3.12"
            % (sys.executable, platform.python_version())
        )
    system = (sys.platform, platform.machine())
    if system not in (("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64")):
        stop(
            "is locked to wheels that Linux on x86-64 and ARM and macOS on ARM have, and this is "
            "%s on %s; use a container or a remote machine"
            % (platform.system(), platform.machine())
        )


def last_line(text):
    """Return the last line of a program's output that names an error, or else the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if "ERROR" in line or "rror:" in line]
    return (errors or lines or ["no message"])[-1]


def make_venv():
    """Make the virtual environment, and return the pip command that installs into it."""
    command = [sys.executable, "-m", "venv", "--clear", VENV]
    inside = os.path.join(VENV, "bin", "python")
    try:
        import ensurepip  # noqa: F401

        subprocess.run(command, check=True, capture_output=True, text=True)
        return [inside, "-m", "pip"]
    except ImportError:  # Debian has ensurepip in another package
        pass
    except subprocess.CalledProcessError as error:
        stop("cannot make %s: %s" % (VENV, last_line(error.stderr or error.stdout)))
    try:
        subprocess.run([*command, "--without-pip"], check=True, capture_output=True, text=True)
        pip = [sys.executable, "-m", "pip", "--python", inside]
        subprocess.run([*pip, "--version"], check=True, capture_output=True, text=True)
        return pip
    except subprocess.CalledProcessError:
        stop("this Python has neither ensurepip nor pip; install python3-venv with apt, or pip")


def install(pip, title, *arguments):
    """Run pip: its output goes to the log file, and each package's name to the screen.

    Args:
      pip: the pip command.
      title: a line to print first.
      *arguments: the arguments of `pip install`.
    """
    print("%s (log: .venv/install.log)" % title)
    command = [*pip, "install", "--disable-pip-version-check", "--progress-bar", "off", *arguments]
    with open(LOG, "a") as log:
        process = subprocess.Popen(
            command, cwd=HERE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        text, count = "", 0
        for line in process.stdout:
            log.write(line)
            text += line
            if line.startswith("Collecting"):
                count += 1
                print("  %3d  %s" % (count, line.split()[1].split("==")[0]), flush=True)
        if process.wait() == 0:
            return
    network = (
        "NewConnectionError",
        "Temporary failure",
        "ConnectTimeout",
        "No address",
        "timed out",
        "(from versions: none)",
    )
    if any(sign in text for sign in network):
        stop("cannot reach the package index; connect to a network and run make .venv again")
    stop("installation failed, see .venv/install.log: %s" % last_line(text))


def complete(name):
    """Create an empty file in .venv that tells make that a step is complete."""
    open(os.path.join(VENV, name), "w").close()


EXTRAS = {
    "sweeps": "launchers and trackers, about 400 MB",
    "jax-envs": "environments in JAX, about 200 MB",
    "docs": "what builds the manual, about 100 MB",
}


def add_extra(name):
    """Install the packages of an extra."""
    pip = [os.path.join(VENV, "bin", "python"), "-m", "pip"]
    if not os.path.exists(os.path.join(VENV, "bin", "pip")):
        pip = [sys.executable, "-m", "pip", "--python", os.path.join(VENV, "bin", "python")]
    title = "installing " + EXTRAS[name]
    install(pip, title, "--no-deps", "-r", "requirements-%s.txt" % name)
    complete("." + name)


def main():
    check_platform()
    if sys.argv[1:]:
        return add_extra(sys.argv[1])
    print("making .venv with %s" % sys.executable, flush=True)
    pip = make_venv()
    install(
        pip, "installing the pinned packages, about 1 GB", "--no-deps", "-r", "requirements.txt"
    )
    install(pip, "installing sndjax itself", "--no-deps", "--no-build-isolation", "-e", ".")
    complete(".complete")


if __name__ == "__main__":
    main()
