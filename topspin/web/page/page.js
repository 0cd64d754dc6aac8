// The page: one ball after the other. While one is shown, the next one is simulated.
import { Match } from "./match.js";
import { Stage } from "./scene.js";
import { Clock, jointsAt, pathOf, pathUntil } from "./show.js";

const element = (id) => document.getElementById(id);
const css = (rgb) => `rgb(${rgb.map((part) => Math.round(255 * part)).join(" ")})`;
const percent = (part, all) => (all ? `${Math.round((100 * part) / all)} %` : "–");
const nextPicture = () => new Promise(requestAnimationFrame);

async function read(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name} is missing: ${answer.status} ${answer.statusText}`);
  return answer.arrayBuffer();
}

class Page {
  constructor(match) {
    this.match = match;
    this.facts = match.facts;
    this.stage = new Stage(element("scene"), this.facts.scene);
    this.isPaused = false;
    this.setUpPanel();
  }

  setUpPanel() {
    const { kinds, policy, robot, scene } = this.facts;
    element("policy").textContent = `policy ${policy}, robot ${robot.name}`;
    element("kind").append(...kinds.map((kind) => new Option(kind)));
    element("legend").append(...scene.trail.map(({ colour, label }) => {
      const chip = Object.assign(document.createElement("span"), { className: "chip", textContent: label });
      chip.style.setProperty("--colour", css(colour));
      return chip;
    }));
    element("pause").onclick = () => this.pause(!this.isPaused);
    element("next").onclick = () => { this.isSkipped = true; };
    element("kind").onchange = () => { this.isChanged = true; };
    addEventListener("keydown", ({ key, target }) => {
      if (target.closest("button, select")) return;
      if (key === " ") this.pause(!this.isPaused);
      if (key === "n") this.isSkipped = true;
    });
  }

  pause(isPaused) {
    this.isPaused = isPaused;
    element("pause").textContent = isPaused ? "Play" : "Pause";
  }

  /** Show balls of the chosen kind until another kind is chosen. */
  async playKind() {
    this.isChanged = false;
    this.score = { balls: 0, returned: 0, caught: 0, error: 0 };
    const balls = await this.match.balls(element("kind").value);
    let coming = this.simulate(balls.of(0));
    for (let number = 0; !this.isChanged; number++) {
      this.isHurried = true; // until the ball that is due is there
      const rally = await coming;
      this.isHurried = false;
      coming = this.simulate(balls.of(number + 1));
      await this.show(rally, number + 1);
      if (!this.isChanged) this.count(rally);
    }
    this.isHurried = true;
    await coming; // there is one robot
  }

  /** Simulate a ball, a control step for each picture: so pictures keep their pace on a slow machine. */
  simulate(ball) {
    return this.match.play(ball, () => (this.isHurried ? null : nextPicture()));
  }

  async show(rally, number) {
    const { grid_s: gridStep, robot, scene } = this.facts;
    const path = pathOf(rally, gridStep), clock = new Clock(rally.time), left = this.joints ?? rally.joints[0];
    this.stage.begin(rally, gridStep);
    this.isSkipped = false;
    element("number").textContent = number;
    this.showScore();
    let last = await nextPicture();
    while (!clock.isOver && !this.isSkipped && !this.isChanged) {
      this.joints = jointsAt(rally, clock.time, robot.step_s, left);
      this.match.robot.poses(this.joints, scene.bodies, (...pose) => this.stage.place(...pose));
      this.stage.showBall(pathUntil(path, clock.time), clock.time);
      this.stage.draw();
      this.showFlight(rally, clock, gridStep);
      const now = await nextPicture();
      if (!this.isPaused) clock.goOn((now - last) / 1000, Number(element("speed").value));
      last = now;
    }
  }

  showFlight(rally, clock, gridStep) {
    const k = Math.min(Math.max(Math.floor(clock.time / gridStep), 0), rally.grid.length - 1);
    const { vel, spin, state } = rally.grid[k], { good, bad } = this.facts.scene.colours;
    const isReturned = rally.outcome === this.facts.returned;
    element("flight").textContent = `${Math.hypot(...vel).toFixed(1)} m/s, spin ${Math.hypot(...spin).toFixed(0)} rad/s`;
    const isKnown = clock.time >= rally.time || state === 3;
    const where = isReturned ? `, ${(100 * rally.landingError).toFixed(0)} cm from the target` : "";
    const text = (this.facts.outcomes[rally.outcome] || "the simulation failed") + where;
    element("verdict").textContent = isKnown ? text : clock.time < 0 ? "next ball" : this.facts.scene.trail[state].label;
    element("verdict").style.color = isKnown ? css(isReturned ? good : bad) : "";
  }

  count({ outcome, caught, landingError }) {
    if (outcome === 0) return; // the simulation failed
    const isReturned = outcome === this.facts.returned;
    this.score.balls += 1;
    this.score.caught += caught;
    this.score.returned += isReturned;
    this.score.error += isReturned ? landingError : 0;
  }

  showScore() {
    const { balls, returned, caught, error } = this.score;
    element("returned").textContent = percent(returned, balls);
    element("caught").textContent = percent(caught, balls);
    element("missed").textContent = percent(balls - caught, balls);
    element("error").textContent = returned ? `${Math.round((100 * error) / returned)} cm` : "–";
  }
}

try {
  const page = new Page(await Match.load(read));
  element("status").hidden = true;
  element("panel").hidden = false;
  for (;;) await page.playKind();
} catch (error) {
  element("status").hidden = false;
  element("status").textContent = `The page can't play: ${error.message}`;
  throw error;
}
