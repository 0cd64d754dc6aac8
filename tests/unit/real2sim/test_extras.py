import subprocess
import sys

LOADED = (
    "import sys, common.real2sim.recordings, common.real2sim.replay, common.real2sim.kinematic; "
    "print(sorted({'scipy', 'h5py', 'matplotlib', 'torch', 'mujoco'} & set(sys.modules)))"
)


def test_recorded_states_become_rallies_without_any_extra():
    found = subprocess.run([sys.executable, "-c", LOADED], check=True, capture_output=True, text=True)

    assert found.stdout == "[]\n"
