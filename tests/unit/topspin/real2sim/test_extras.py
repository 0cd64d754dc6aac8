import subprocess
import sys

WITHOUT = (
    "import sys; sys.modules.update(dict.fromkeys(('scipy', 'h5py', 'matplotlib', 'torch', 'mujoco'))); "
    "import topspin.real2sim.formats.recordings, topspin.real2sim.replay, topspin.real2sim.kinematic"
)


def test_recorded_states_become_rallies_without_any_extra():
    subprocess.run([sys.executable, "-c", WITHOUT], check=True)
