// WebGL renderer with a self-test: graphics chips of cheap tablets have drawn grey squares or nothing, without an
// error. One context serves all viewers; it maps pixel to pixel without interpolation, and copies the result to a 2-D
// canvas.

import { context2d } from "../../core/viewport.js";
import { NEUTRAL, lookupTable } from "./lookup_table.js";

const TOLERANCE = 2; // of 255; largest accepted difference
const TEST_SIDE = 16; // 16 x 16 pixels hold every value of each channel
const SELF_TESTS = [
  NEUTRAL,
  { ...NEUTRAL, redfree: true },
  { ...NEUTRAL, contrast: 5 },
  { ...NEUTRAL, contrast: -5 },
  { ...NEUTRAL, brightness: 5 },
  { redfree: true, brightness: -5, contrast: 3 },
];

const VERTEX = `#version 300 es
void main() { // one triangle that covers everything
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D picture;
uniform sampler2D table;
uniform bool redfree;
out vec4 colour;
float toned(float value) { return texelFetch(table, ivec2(int(value * 255.0 + 0.5), 0), 0).r; }
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy); // GL counts rows from below, pictures from above
  vec3 was = texelFetch(picture, ivec2(at.x, textureSize(picture, 0).y - 1 - at.y), 0).rgb;
  colour = vec4(redfree ? vec3(toned(was.g)) : vec3(toned(was.r), toned(was.g), toned(was.b)), 1.0);
}`;

/** Failure of WebGL: not available, wrong output, or context lost. */
export class WebglError extends Error {}

/**
 * Return a hardware WebGL2 context, or null; also null where the browser would emulate it, which is slower than
 * JavaScript. The context belongs to a canvas of the page, because browsers apply their list of untrusted chips there.
 */
export function openWebgl() {
  const options = { alpha: false, antialias: false, depth: false, stencil: false };
  return document.createElement("canvas").getContext("webgl2", { ...options, failIfMajorPerformanceCaveat: true });
}

/** Renderer on a WebGL2 context. */
export class RendererWebgl {
  name = "gl";

  /** Run the self-test; WebglError if it fails or `gl` is null. `onLost` is called when the context is lost. */
  constructor(gl, onLost) {
    if (!gl) throw new WebglError("this browser offers no WebGL2 on a chip");
    this.gl = gl;
    gl.canvas.addEventListener("webglcontextlost", onLost);
    this.uniforms = this.#buildProgram();
    this.table = this.#createTexture(1);
    this.#selfTest();
  }

  /** Upload a picture and compare its middle row: large textures can fail where small ones pass. */
  load(picture) {
    const { gl } = this;
    const { width, height } = picture;
    const texture = this.#createTexture(0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    const output = Object.assign(document.createElement("canvas"), { width, height });
    const handle = { texture, output, context: context2d(output, { alpha: false }) };
    this.draw(handle, { redfree: false, table: lookupTable(0, NEUTRAL) });
    compare(readRows(output, height >> 1, 1), readRows(picture, height >> 1, 1), "a whole picture");
    return handle;
  }

  /** Draw the picture with the tools on its output canvas. */
  draw({ texture, output, context }, { redfree, table }) {
    const { gl } = this;
    const { width, height } = output;
    if (gl.canvas.width !== width || gl.canvas.height !== height) Object.assign(gl.canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.table);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, 256, 1, 0, gl.RED, gl.UNSIGNED_BYTE, new Uint8Array(table));
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(this.uniforms.redfree, Number(redfree));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    context.drawImage(gl.canvas, 0, 0);
    const error = gl.getError();
    if (gl.isContextLost() || error) throw new WebglError(gl.isContextLost() ? "it went away" : `WebGL error ${error}`);
    return output;
  }

  release({ texture, output }) {
    this.gl.deleteTexture(texture);
    output.width = output.height = 0;
    Object.assign(this.gl.canvas, { width: 1, height: 1 });
  }

  #buildProgram() {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new WebglError(`no shader: ${gl.getProgramInfoLog(program)}`);
    gl.useProgram(program);
    gl.uniform1i(gl.getUniformLocation(program, "picture"), 0);
    gl.uniform1i(gl.getUniformLocation(program, "table"), 1);
    return { redfree: gl.getUniformLocation(program, "redfree") };
  }

  #createTexture(unit) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, gl.NEAREST);
    for (const which of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, which, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Draw a test picture with each set of tools up to the canvas, and compare with the expected values. */
  #selfTest() {
    const picture = testPicture();
    const input = readRows(picture, 0, TEST_SIDE);
    const handle = this.load(picture);
    for (const tools of SELF_TESTS) {
      const table = lookupTable(100, tools);
      const expected = input.map((value, i) => (i % 4 === 3 ? 255 : table[tools.redfree ? input[i - (i % 4) + 1] : value]));
      const drawn = this.draw(handle, { redfree: tools.redfree, table });
      compare(readRows(drawn, 0, TEST_SIDE), expected, JSON.stringify(tools));
    }
    this.release(handle);
  }
}

function testPicture() {
  const canvas = Object.assign(document.createElement("canvas"), { width: TEST_SIDE, height: TEST_SIDE });
  const context = context2d(canvas);
  const pixels = context.createImageData(TEST_SIDE, TEST_SIDE);
  for (let i = 0; i < 256; i += 1) pixels.data.set([i, 255 - i, (i * 7) % 256, 255], 4 * i);
  context.putImageData(pixels, 0, 0);
  return canvas;
}

/** Return the RGBA values of some rows of a picture or canvas. */
function readRows(source, first, count) {
  const canvas = Object.assign(document.createElement("canvas"), { width: source.width, height: count });
  const context = context2d(canvas, { willReadFrequently: true });
  context.drawImage(source, 0, -first);
  return context.getImageData(0, 0, source.width, count).data;
}

function compare(got, wanted, what) {
  const at = wanted.findIndex((value, i) => Math.abs(got[i] - value) > TOLERANCE);
  if (at >= 0) throw new WebglError(`it draws ${got[at]} instead of ${wanted[at]} (${what})`);
}
