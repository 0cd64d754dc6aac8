// Plays recorded rallies with the page's ball, and prints the largest differences: node drive.mjs FOLDER.
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const folder = path.resolve(process.argv[2]);
const read = (name) => new Uint8Array(fs.readFileSync(path.join(folder, name))).buffer;
const parsed = (name) => JSON.parse(fs.readFileSync(path.join(folder, name)));
const { Ball } = await import(pathToFileURL(path.join(folder, "ball.mjs")));
const worst = (before, ours, theirs) =>
  ours.reduce((most, value, k) => { // a difference that is no number is the worst of all
    const found = Math.abs(value - theirs[k]);
    return found <= most ? most : found;
  }, before);

const ball = await Ball.load(read("ball.wasm"), read("values.bin"), parsed("places.json"));
const found = { obs: 0, pos: 0, vel: 0, spin: 0, outcomes: 0, steps: 0 };
for (const { launch, seed, steps } of parsed("rallies.json")) {
  ball.begin(launch, BigInt(seed));
  for (const step of steps) {
    const obs = Array.from(ball.observe(step.joint_pos, step.joint_vel));
    found.obs = worst(found.obs, obs, step.obs);
    found.outcomes += ball.play(step.joint_pos, step.path, step.actions) !== step.outcome;
    found.steps += 1;
    if (step.ball) {
      const state = Array.from(ball.at("rallies.ball"));
      ["pos", "vel", "spin"].forEach((part, k) => {
        const at = [3 * k, 3 * k + 3];
        found[part] = worst(found[part], state.slice(...at), step.ball.slice(...at));
      });
    }
  }
}
console.log(JSON.stringify(found));
