// The robot in MuJoCo: joint targets in, joint motion out. The JavaScript of common/env/robot.py for one robot.

const PARAMETERS = 10, KP = 4, KV = 6; // of an actuator's gain: how many, and where a dcmotor has its controller's
const JOINTS = 7;

/** MuJoCo went back to its start because a number was not finite or too large. */
export class SimulationFault extends Error {}

export class Robot {
  /**
   * @param {object} mujoco the module of @mujoco/mujoco
   * @param {string} xml the robot's model
   * @param {object} facts "robot" of page.json
   */
  constructor(mujoco, xml, facts) {
    Object.assign(this, facts);
    this.mujoco = mujoco;
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.model.opt.timestep = this.step_s;
    this.data = new mujoco.MjData(this.model);
    this.drawn = new mujoco.MjData(this.model); // poses of other moments
    this.racketBody = this.model.body(this.racket).id;
    this.damping = Array.from(this.model.dof_damping).slice(0, JOINTS);
    this.path = new Float64Array(this.substeps * JOINTS);
  }

  get jointPos() { return this.data.qpos.slice(0, JOINTS); }
  get jointVel() { return this.data.qvel.slice(0, JOINTS); }

  /** Go to home plus offset, at rest, with drives of these gain factors (3 x 7: kp, kv, damping) and latency [s]. */
  begin(offset, gains, latency) {
    const { model, data } = this;
    this.mujoco.mj_resetDataKeyframe(model, data, 0);
    for (let j = 0; j < JOINTS; j++) {
      data.qpos[j] = this.home[j] + offset[j];
      model.actuator_gainprm[PARAMETERS * j + KP] = this.kp[j] * gains[j];
      model.actuator_gainprm[PARAMETERS * j + KV] = this.kv[j] * gains[JOINTS + j];
      model.dof_damping[j] = this.damping[j] * gains[2 * JOINTS + j];
    }
    this.lateSteps = Math.round(latency / this.step_s);
    const kept = 1 + Math.ceil(this.lateSteps / this.substeps); // newest first
    this.targets = Array.from({ length: kept }, () => Float64Array.from(this.home));
  }

  /** Move for one control step under actions in -1 .. 1; return the joint positions after each of MuJoCo's steps. */
  step(actions) {
    const { model, data, targets } = this;
    targets.pop();
    targets.unshift(Float64Array.from(actions, (a, j) => this.middle[j] + this.half_range[j] * a));
    const end = data.time + this.substeps * this.step_s;
    for (let k = 0; k < this.substeps; k++) {
      let age = 0;
      while (age + 1 < targets.length && k < this.lateSteps - age * this.substeps) age++;
      data.ctrl.set(targets[age]);
      this.mujoco.mj_step(model, data);
      this.path.set(data.qpos.subarray(0, JOINTS), k * JOINTS);
    }
    if (!(Math.abs(data.time - end) < 0.5 * this.step_s)) throw new SimulationFault("the robot's simulation failed");
    return this.path;
  }

  /** Let an impulse at the racket's centre (6) [N s, N m s] act during the next control step. */
  push(impulse) {
    const scale = 1 / (this.substeps * this.step_s);
    for (let k = 0; k < 6; k++) this.data.xfrc_applied[6 * this.racketBody + k] = impulse[k] * scale;
  }

  /** Call place(name, position, quaternion w x y z) for bodies of the robot at these joint positions. */
  poses(joints, names, place) {
    const { model, drawn } = this;
    drawn.qpos.set(joints);
    this.mujoco.mj_kinematics(model, drawn);
    for (const name of names) {
      const id = model.body(name).id;
      place(name, drawn.xpos.subarray(3 * id, 3 * id + 3), drawn.xquat.subarray(4 * id, 4 * id + 4));
    }
  }
}
