from pathlib import Path

import topspin_robot

controller = topspin_robot.load(Path(__file__).parent)  # an exported folder; compiles once, then is warm
controller.begin(target=(0.9, -0.3))  # a new ball, and where to return it [m]
home = [joint.home for joint in controller.contract.joints]

for step in range(20):  # 50 times a second
    now = 0.02 * step  # [s] this example's clock and ball; yours are your camera's
    controller.see(now, (1.3 - 5.0 * now, 0.1, 0.3 + 1.0 * now - 4.9 * now**2))
    command = controller.step(now, joint_pos=home, joint_vel=[0.0] * 7)
    print(f"{now:.2f} s", command.positions.round(3))  # joint targets [m, rad], always finite
print(f"bad measurements: {dict(controller.faults)}")
