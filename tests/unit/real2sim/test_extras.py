import subprocess
import sys

WITHOUT = (
    "import sys; sys.modules.update(dict.fromkeys(('scipy', 'h5py', 'matplotlib', 'torch', 'mujoco'))); "
    "import common.real2sim.recordings, common.real2sim.replay, common.real2sim.kinematic"
)


def test_recorded_states_become_rallies_without_any_extra():
    subprocess.run([sys.executable, "-c", WITHOUT], check=True)
