from pathlib import Path

import topspin_robot

controller = topspin_robot.load(Path(__file__).parent)  # compiles once
controller.begin(target=(0.9, -0.3))  # a new ball [m]
home = [joint.home for joint in controller.contract.joints]
for step in range(20):
    now = step * controller.contract.period  # [s] yours: measured times, balls and joints
    controller.see(now, (1.3 - 5.0 * now, 0.1, 0.3 + now - 4.9 * now**2))
    command = controller.step(now, home, [0.0] * 7)
    print(command.positions.round(2))  # joint targets [m, rad], always finite
print(dict(controller.faults))  # bad measurements, by kind
