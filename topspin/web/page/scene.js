// The hall, the robot and the ball, drawn by three.js. z points up, as in Topspin.
import * as THREE from "three";
import { OrbitControls } from "./vendor/OrbitControls.js";

const BACKGROUND = 0x262c36;
const FLOOR_HALF = 5; // [m] boxes larger than this are the floor
const TRAIL_RADIUS = 0.007; // [m]
const STRIDE = 2; // grid steps of a trail's segment
const TARGET = [0.1, 0.075, 0.04]; // [m] radii of its rings
const UP = new THREE.Vector3(0, 1, 0); // axis of three.js's cylinders

const colourOf = (rgb) => new THREE.Color().setRGB(...rgb, THREE.SRGBColorSpace);

function geometryOf({ form, half }) {
  const [a, b, c] = half;
  if (form === "box") return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
  const round = form === "capsule" ? new THREE.CapsuleGeometry(a, 2 * b, 8, 20) : new THREE.CylinderGeometry(a, a, 2 * b, 32);
  return round.rotateX(Math.PI / 2); // MuJoCo's axis is z
}

/** Return a ball whose eight octants have two colours, which show its spin. */
function ballOf(radius) {
  const geometry = new THREE.IcosahedronGeometry(radius, 6);
  const { position } = geometry.attributes, colours = new Float32Array(3 * position.count);
  const dark = colourOf([0.95, 0.42, 0.08]), bright = colourOf([1, 1, 0.97]);
  for (let face = 0; face < position.count; face += 3) {
    const centre = [0, 1, 2].map((axis) => [0, 1, 2].reduce((sum, k) => sum + position.getComponent(face + k, axis), 0));
    const colour = centre.filter((value) => value > 0).length % 2 ? bright : dark;
    for (let k = 0; k < 3; k++) colour.toArray(colours, 3 * (face + k));
  }
  geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  const ball = new THREE.Mesh(geometry, new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.5 }));
  ball.name = "ball";
  ball.castShadow = true;
  return ball;
}

export class Stage {
  /** @param {object} facts "scene" of page.json */
  constructor(canvas, facts) {
    this.facts = facts;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(BACKGROUND);
    this.scene.fog = new THREE.Fog(BACKGROUND, 6, 13);
    this.setUpCamera(canvas);
    this.setUpLight();
    this.bodies = new Map(facts.bodies.map((name) => [name, this.scene.add(new THREE.Group()).children.at(-1)]));
    for (const shape of facts.shapes) this.add(shape);
    this.scene.add((this.ball = ballOf(facts.ball_radius)));
    this.target = new THREE.Group();
    TARGET.forEach((radius, k) => this.target.add(this.disc(radius, 0.002 + 0.003 * k, k % 2 ? [1, 1, 1] : facts.colours.target)));
    this.scene.add(this.target, (this.landing = this.disc(0.022, 0.012, facts.trail[3].colour)));
    this.setUpTrail();
  }

  setUpCamera(canvas) {
    this.isUpright = canvas.clientHeight > canvas.clientWidth; // a phone: behind the robot, above the panel
    const { look_at, distance, azimuth_deg, elevation_deg } = this.facts.cameras[this.isUpright ? "upright" : "wide"];
    const [azimuth, elevation] = [azimuth_deg, elevation_deg].map(THREE.MathUtils.degToRad);
    this.camera = new THREE.PerspectiveCamera(this.facts.field_of_view_deg, 1, 0.05, 30);
    this.camera.up.set(0, 0, 1);
    const ahead = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    this.camera.position.set(...look_at.map((value, axis) => value - distance * ahead[axis]));
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.target.set(...look_at);
    this.controls.maxPolarAngle = 1.75; // not far under the table
    [this.controls.minDistance, this.controls.maxDistance] = [0.6, 9];
  }

  setUpLight() {
    const lamp = new THREE.DirectionalLight(0xffffff, 2.2), fill = new THREE.DirectionalLight(0xbecdeb, 0.4);
    lamp.position.set(-1.2, -1.9, 5.6);
    fill.position.set(3, 3, 3.5);
    lamp.castShadow = true;
    lamp.shadow.mapSize.set(2048, 2048);
    Object.assign(lamp.shadow.camera, { left: -3, right: 3, top: 3, bottom: -3, near: 1, far: 9 });
    lamp.shadow.normalBias = 0.01;
    const sky = new THREE.HemisphereLight(0xe2e9f5, 0x69554f, 1.4);
    sky.position.set(0, 0, 1);
    this.scene.add(lamp, fill, sky);
  }

  setUpTrail() {
    const most = 1024, geometry = new THREE.CylinderGeometry(TRAIL_RADIUS, TRAIL_RADIUS, 1, 6, 1, true);
    this.trail = new THREE.InstancedMesh(geometry, new THREE.MeshBasicMaterial(), most);
    this.trail.frustumCulled = false;
    this.trail.count = 0;
    this.trailColours = this.facts.trail.map(({ colour }) => colourOf(colour));
    this.scene.add(this.trail);
  }

  add(shape) {
    const isFloor = shape.half[0] > FLOOR_HALF, isClear = shape.opacity < 1;
    const material = new THREE.MeshStandardMaterial({
      color: colourOf(shape.colour), roughness: 0.75, transparent: isClear, opacity: shape.opacity,
    });
    const mesh = new THREE.Mesh(geometryOf(shape), material);
    mesh.position.set(...shape.pos);
    mesh.quaternion.set(shape.quat[1], shape.quat[2], shape.quat[3], shape.quat[0]);
    mesh.receiveShadow = true;
    mesh.castShadow = !isFloor && !isClear;
    (this.bodies.get(shape.body) ?? this.scene).add(mesh);
  }

  disc(radius, height, rgb) {
    const geometry = new THREE.CylinderGeometry(radius, radius, height, 40).rotateX(Math.PI / 2);
    const disc = new THREE.Mesh(geometry, new THREE.MeshStandardMaterial({ color: colourOf(rgb), roughness: 0.9 }));
    disc.position.z = height / 2;
    return disc;
  }

  /** Take over a rally: its target, and how the ball turns. */
  begin(rally, gridStep) {
    this.target.position.set(...rally.target, 0);
    this.landing.position.set(...rally.landing.map((value) => value || 0), 0.006);
    const turn = new THREE.Quaternion(), step = new THREE.Quaternion(), axis = new THREE.Vector3();
    this.turns = rally.grid.map(({ spin }) => {
      axis.set(...spin);
      const rate = axis.length();
      if (rate > 0) turn.premultiply(step.setFromAxisAngle(axis.divideScalar(rate), rate * gridStep)).normalize();
      return turn.clone();
    });
    this.gridStep = gridStep;
  }

  /**
   * Show the ball at a time.
   * @param {object[]} path until then, as show.pathUntil returns it
   */
  showBall(path, time) {
    const k = Math.min(Math.max(Math.floor(time / this.gridStep), 0), this.turns.length - 1);
    const after = this.turns[Math.min(k + 1, this.turns.length - 1)];
    this.ball.position.set(...path.at(-1).pos);
    this.ball.quaternion.slerpQuaternions(this.turns[k], after, Math.min(Math.max(time / this.gridStep - k, 0), 1));
    this.landing.visible = path.some(({ state }) => state === 3);
    const corners = path.filter(({ state }, index) => index % STRIDE === 0 || index === path.length - 1 || state !== path[index + 1].state);
    const matrix = new THREE.Matrix4(), turn = new THREE.Quaternion(), along = new THREE.Vector3();
    this.trail.count = Math.min(corners.length - 1, this.trail.instanceMatrix.count);
    for (let segment = 0; segment < this.trail.count; segment++) {
      const from = new THREE.Vector3(...corners[segment].pos), to = new THREE.Vector3(...corners[segment + 1].pos);
      const length = along.subVectors(to, from).length();
      turn.setFromUnitVectors(UP, along.divideScalar(length || 1));
      matrix.compose(from.add(to).divideScalar(2), turn, new THREE.Vector3(1, length, 1));
      this.trail.setMatrixAt(segment, matrix);
      this.trail.setColorAt(segment, this.trailColours[corners[segment + 1].state]);
    }
    this.trail.instanceMatrix.needsUpdate = true;
    if (this.trail.instanceColor) this.trail.instanceColor.needsUpdate = true;
  }

  /** Put a body of the robot into its place; the quaternion is (w, x, y, z). */
  place(name, pos, quat) {
    const body = this.bodies.get(name);
    body.position.set(...pos);
    body.quaternion.set(quat[1], quat[2], quat[3], quat[0]);
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement, ratio = Math.min(devicePixelRatio, 2);
    if (width !== this.width || height !== this.height) {
      [this.width, this.height] = [width, height];
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / height;
      const [right, down] = this.isUpright ? [0, 0.16] : [0.06, 0]; // from the panel, as shares of the picture
      this.camera.fov = this.facts.field_of_view_deg * (this.isUpright ? 1.6 : 1.1);
      this.camera.setViewOffset(width, height, -right * width, down * height, width, height);
      this.camera.updateProjectionMatrix();
    }
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}
