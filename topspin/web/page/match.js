// One ball after the other, each simulated whole: by the rules of `topspin evaluate`, the robot starting near home.
import { Ball } from "./ball.js";
import { Policy } from "./policy.js";
import { Robot, SimulationFault } from "./robot.js";
import loadMujoco from "./vendor/mujoco.js";

const SAMPLE = 7; // numbers of a true sample: position, velocity, state
const JOINTS = 7;
const LAUNCH = 12;

/** Launches and seeds of one kind of ball, as the page's folder has them. */
export class Balls {
  constructor(file, count) {
    this.count = count;
    this.launches = new Float64Array(file, 0, LAUNCH * count);
    this.seeds = new BigUint64Array(file, 8 * LAUNCH * count, count);
  }

  of(number) {
    const k = number % this.count;
    return { launch: this.launches.subarray(LAUNCH * k, LAUNCH * (k + 1)), seed: this.seeds[k] };
  }
}

export class Match {
  /** @param {function(string): Promise<ArrayBuffer>} read returns a file of the page's folder */
  static async load(read) {
    const text = async (name) => new TextDecoder().decode(await read(name));
    const match = new Match();
    match.read = read;
    match.facts = JSON.parse(await text("page.json"));
    const { places, robot } = match.facts;
    [match.ball, match.policy, match.robot] = await Promise.all([
      Promise.all([read("ball.wasm"), read("values.bin")]).then(([code, block]) => Ball.load(code, block, places)),
      read("policy.onnx").then(Policy.load),
      Promise.all([loadMujoco(), text("robot.xml")]).then(([mujoco, xml]) => new Robot(mujoco, xml, robot)),
    ]);
    return match;
  }

  /** Return the balls of a kind of page.json. */
  async balls(kind) {
    return new Balls(await this.read(`balls/${kind}.bin`), this.facts.balls);
  }

  /**
   * Play a ball to its end; return what happened.
   * time: of its end [s]; outcome: a number of page.json's outcomes, 0 where the simulation failed;
   * target, landing (2) [m], landingError [m], caught; grid: samples { pos, vel, spin, state } at multiples of grid_s;
   * joints: positions at multiples of the robot's step_s.
   * @param {function} rest is awaited after each control step
   */
  async play({ launch, seed }, rest = () => null) {
    const { ball, robot, policy, facts } = this;
    ball.begin(launch, seed);
    const parameters = ball.at("rallies.parameters").slice();
    robot.begin(ball.at("offset"), ball.at("gains"), parameters[facts.parameters.ACTION_LATENCY]);
    const rally = {
      outcome: 0,
      target: [parameters[facts.parameters.TARGET_X], parameters[facts.parameters.TARGET_Y]],
      grid: this.newSamples(0),
      joints: [robot.jointPos],
    };
    try {
      while (rally.outcome === 0) {
        const start = robot.jointPos, clock = Number(ball.at("rallies.clock")[0]);
        const actions = await policy.act(ball.observe(start, robot.jointVel));
        const path = robot.step(actions);
        rally.outcome = ball.play(start, path, actions);
        robot.push(ball.at("step.impulse"));
        rally.grid.push(...this.newSamples(Number(ball.at("rallies.clock")[0]) - clock - 1));
        for (let k = 0; k < robot.substeps; k++) rally.joints.push(path.slice(JOINTS * k, JOINTS * (k + 1)));
        await rest();
      }
    } catch (error) {
      if (!(error instanceof SimulationFault)) throw error;
    }
    return Object.assign(rally, {
      time: (rally.grid.length - 1) * facts.grid_s,
      landing: Array.from(ball.at("rallies.landing")),
      landingError: ball.at("rallies.landing_error")[0],
      caught: ball.at("rallies.caught")[0] !== 0,
    });
  }

  /** Return the newest true sample, and so many earlier ones before it. */
  newSamples(earlier) {
    const { ball } = this;
    const ring = ball.at("rallies.true_sample_ring"), head = Number(ball.at("rallies.head")[0]);
    const rows = ring.length / SAMPLE, spin = Array.from(ball.at("rallies.ball").subarray(6, 9));
    return Array.from({ length: earlier + 1 }, (_, k) => {
      const at = SAMPLE * ((head - earlier + k + rows) % rows);
      return { pos: ring.slice(at, at + 3), vel: ring.slice(at + 3, at + 6), spin, state: ring[at + 6] };
    });
  }
}
