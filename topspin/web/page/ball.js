// Ball, rules, perception and observation: Topspin's own kernels, compiled to WebAssembly (topspin/web/entry.py).

const PAGE = 65536; // [bytes] of WebAssembly's memory
const STACK_TOP = 1 << 20; // topspin/web/wasm.py: constants and stack are below, the block of values begins here
const BEGIN = 0n, OBSERVE = 1n, PLAY = 2n;
const ARRAYS = {
  float64: Float64Array, float32: Float32Array, int64: BigInt64Array, uint64: BigUint64Array, bool: Uint8Array,
};

/** What the kernels need of numba's run time: memory, which is given back as a whole after each call, and shapes. */
function runtime(memory, heap) {
  let top = heap;
  const take = (bytes) => {
    const at = top;
    top = (at + Number(bytes) + 63) & ~63;
    const missing = top - memory.buffer.byteLength;
    if (missing > 0) memory.grow(Math.ceil(missing / PAGE));
    return at;
  };
  const array = (bytes) => { // numba's MemInfo: count, destructor and its argument, data, size, allocator
    const info = take(48), data = take(bytes);
    new Uint8Array(memory.buffer, info, 48).fill(0);
    new DataView(memory.buffer).setUint32(info + 24, data, true);
    return info;
  };
  const functions = {
    sin: Math.sin, cos: Math.cos, log: Math.log, log10: Math.log10, exp: Math.exp, sqrt: Math.sqrt,
    NRT_incref() {}, NRT_decref() {}, NRT_Free() {},
    NRT_Allocate: take, NRT_MemInfo_alloc: array, NRT_MemInfo_alloc_aligned: array,
    __multi3(result, low, high, otherLow, otherHigh) { // 128 bits
      const product = BigInt.asUintN(128, wide(low, high) * wide(otherLow, otherHigh));
      const view = new DataView(memory.buffer);
      view.setBigUint64(result, BigInt.asUintN(64, product), true);
      view.setBigUint64(result + 8, product >> 64n, true);
    },
    numba_attempt_nocopy_reshape(axes, shape, strides, newAxes, newShape, newStrides, itemSize) {
      const view = new DataView(memory.buffer);
      let stride = itemSize;
      for (let axis = Number(axes) - 1; axis >= 0; axis--) {
        const size = view.getBigInt64(shape + 8 * axis, true);
        if (size !== 1n && view.getBigInt64(strides + 8 * axis, true) !== stride) return 0; // not contiguous: a copy
        stride *= size;
      }
      stride = itemSize;
      for (let axis = Number(newAxes) - 1; axis >= 0; axis--) {
        view.setBigInt64(newStrides + 8 * axis, stride, true);
        stride *= view.getBigInt64(newShape + 8 * axis, true);
      }
      return 1;
    },
  };
  return { functions, release() { top = heap; } };
}

const wide = (low, high) => (BigInt.asUintN(64, high) << 64n) | BigInt.asUintN(64, low);

/** One ball: its values by their names in topspin/web/values.py, and what is done with them. */
export class Ball {
  /**
   * @param {ArrayBuffer} code ball.wasm
   * @param {ArrayBuffer} block the values before a rally
   * @param {Object<string, [string, number, number]>} places type, first byte and count of each value in the block
   */
  static async load(code, block, places) {
    const ball = new Ball();
    ball.start = new Uint8Array(block);
    const pages = Math.ceil((STACK_TOP + block.byteLength) / PAGE) + 4;
    const memory = new WebAssembly.Memory({ initial: pages, maximum: 4 * pages });
    const { functions, release } = runtime(memory, STACK_TOP + ((block.byteLength + 63) & ~63));
    const module = await WebAssembly.compile(code);
    const env = {
      __linear_memory: memory,
      __stack_pointer: new WebAssembly.Global({ value: "i32", mutable: true }, STACK_TOP),
      __indirect_function_table: new WebAssembly.Table({ initial: 64, element: "anyfunc" }),
    };
    for (const { name, kind } of WebAssembly.Module.imports(module)) {
      if (kind !== "function") continue;
      env[name] = functions[name] ?? (() => { throw new Error(`the kernels failed: ${name}`); }); // Python's errors
    }
    const { exports } = await WebAssembly.instantiate(module, { env });
    ball.call = (what) => {
      release();
      exports.entry(what, BigInt(STACK_TOP));
    };
    ball.at = (name) => { // a growing memory invalidates older views
      const [type, from, count] = places[name];
      return new ARRAYS[type](memory.buffer, STACK_TOP + from, count);
    };
    ball.memory = memory;
    return ball;
  }

  /** Begin a rally: launch is an array of 12 numbers, seed a BigInt. */
  begin(launch, seed) {
    new Uint8Array(this.memory.buffer, STACK_TOP, this.start.length).set(this.start);
    this.at("launch").set(launch);
    this.at("seed")[0] = seed;
    this.call(BEGIN);
  }

  /** Return the observation of a robot with these joints; a view that the next call overwrites. */
  observe(jointPos, jointVel) {
    this.at("joint_pos").set(jointPos);
    this.at("joint_vel").set(jointVel);
    this.call(OBSERVE);
    return this.at("obs");
  }

  /**
   * Play a control step; return the outcome's number, 0 while the rally goes on.
   * @param {number[]} start joint positions before the step
   * @param {number[]} path joint positions after each of MuJoCo's steps in it, one after the other
   */
  play(start, path, actions) {
    this.at("motion.start_pos").set(start);
    this.at("motion.joint_pos").set(path);
    this.at("actions").set(actions);
    this.call(PLAY);
    return Number(this.at("step.outcome")[0]);
  }
}
