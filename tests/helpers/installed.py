"""What an installation with the core alone says of the choices that need more: one sentence each,
with the extra to install. Run in an environment by noxfile.py; needs nothing but the package."""

import subprocess
import sys

NEEDS = {
    "renderer=moderngl_deferred": "gl",
    "renderer=mitsuba_ad": "mitsuba",
    "preview=pyrender": "gl",
    "logger=tensorboard": "tensorboard",
    "logger=mlflow": "mlflow",
    "encoder=clip": "text2mesh",
    "launcher=joblib": "sweep",
    "+search=optuna": "search",
}
SMALL = ["source=torus", "style=rail", "method=robust", "profile=smoke", "metrics.judge=none"]


def refused(override: str) -> str:
    """The one line that a run with this choice ends with."""
    random = [] if override.startswith("encoder=") else ["encoder=vgg19_random"]
    many = ["-m"] if override.startswith(("launcher", "+search")) else []
    command = [sys.executable, "-m", "styleexp", *many, *SMALL, *random, override]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = [x for x in done.stderr.splitlines() if x.strip() and not x.startswith("warning: ")]
    assert done.returncode == 2, f"{override}: exit code {done.returncode}: {done.stderr[-1500:]}"
    assert "Traceback" not in done.stderr, f"{override}: {done.stderr[-1500:]}"
    assert len(told) == 1, f"{override}: {done.stderr[-1500:]}"
    return told[0]


def main() -> None:
    """Try every choice."""
    for override, extra in NEEDS.items():
        told = refused(override)
        assert f"pip install 'styleexp[{extra}]'" in told, f"{override}: {told}"
        print(f"{override}: {told}")


if __name__ == "__main__":
    main()
