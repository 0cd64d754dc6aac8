// The policy's network: an ONNX file, run by ONNX Runtime Web.
import * as ort from "./vendor/ort.wasm.min.mjs";

export class Policy {
  /** @param {ArrayBuffer} file policy.onnx */
  static async load(file) {
    ort.env.wasm.numThreads = 1; // more need headers that a plain file server does not send, and the network is small
    ort.env.wasm.wasmPaths = new URL("./vendor/", import.meta.url).href;
    const policy = new Policy();
    policy.session = await ort.InferenceSession.create(new Uint8Array(file), { executionProviders: ["wasm"] });
    return policy;
  }

  /** Return the actions (7) for an observation. */
  async act(obs) {
    const input = new ort.Tensor("float32", obs, [1, obs.length]);
    return (await this.session.run({ obs: input }, ["actions"])).actions.data;
  }
}
