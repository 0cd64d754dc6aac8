// What a rally looks like at any time, as plain values, and the clock of its show. Nothing here draws or simulates.

const JUMP = 0.6; // [m/s] within a grid step: more than the air does, less than a touch
const APPROACH_S = 0.6; // the robot moves to its start position
const HOLD_S = 1.2; // the outcome can be read
const LONGEST_STEP_S = 0.1; // a longer pause of the browser is not caught up

const mix = (a, b, share) => Array.from(a, (value, k) => value + share * (b[k] - value));
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** Return the ball's path with its touches, each where the flights before and after it meet: [{ time, pos, state }]. */
export function pathOf(rally, gridStep) {
  const path = [{ time: 0, pos: rally.grid[0].pos, state: rally.grid[0].state }];
  for (let k = 1; k < rally.grid.length; k++) {
    const before = rally.grid[k - 1], after = rally.grid[k], time = k * gridStep;
    const change = [0, 1, 2].map((axis) => before.vel[axis] - after.vel[axis]);
    if (Math.hypot(...change) > JUMP) {
      const gap = [0, 1, 2].map((axis) => before.pos[axis] - after.pos[axis] + after.vel[axis] * gridStep);
      const ahead = clamp(-dot(gap, change) / dot(change, change), 0, gridStep);
      const pos = [0, 1, 2].map((axis) => before.pos[axis] + ahead * before.vel[axis]);
      path.push({ time: time - gridStep + ahead, pos, state: before.state });
    }
    path.push({ time, pos: after.pos, state: after.state });
  }
  return path;
}

/** Return the path until a time; its last point is the ball there. */
export function pathUntil(path, time) {
  let count = path.findIndex((point) => point.time > time);
  if (count < 0) return path;
  count = Math.max(count, 1);
  const a = path[count - 1], b = path[count];
  const share = clamp((time - a.time) / (b.time - a.time), 0, 1);
  return [...path.slice(0, count), { time, pos: mix(a.pos, b.pos, share), state: b.state }];
}

/** Return the joints [m, rad] at a time; before the launch they come from where they were left. */
export function jointsAt(rally, time, step, left) {
  if (time < 0) {
    const share = clamp(1 + time / APPROACH_S, 0, 1);
    return mix(left, rally.joints[0], share * share * (3 - 2 * share));
  }
  const last = rally.joints.length - 1, k = Math.min(Math.floor(time / step + 1e-6), last);
  return mix(rally.joints[k], rally.joints[Math.min(k + 1, last)], clamp(time / step - k, 0, 1));
}

/** The clock: the robot takes its start position, the ball flies, and the last picture is held. */
export class Clock {
  constructor(end) {
    this.end = end;
    this.time = -APPROACH_S;
  }

  get isOver() { return this.time >= this.end + HOLD_S; }

  /** Go on by passed seconds of real time; only the flight is slow. */
  goOn(passed, speed) {
    const isFlight = this.time >= 0 && this.time < this.end;
    this.time += Math.min(passed, LONGEST_STEP_S) * (isFlight ? speed : 1);
  }
}
