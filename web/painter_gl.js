// The painter on the graphics chip, which proves itself before it is believed: cheap tablets' chips have drawn grey
// squares and nothing at all without any error. One context serves every viewer of the page; it draws one pixel for one
// pixel, interpolates nothing, and hands the result over on an ordinary canvas.

import { NEUTRAL, toneTable } from "./tone.js";

const OFF_BY = 2; // of 255: what a true chip may be off by
const PROOF_SIDE = 16; // 16 x 16 pixels hold every value of every channel
const PROOFS = [
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

/** The chip cannot do it, did it wrong, or went away. */
export class GlFault extends Error {}

/**
 * A context of this tablet's chip, or null: also where the browser would only imitate a chip, which is slower than
 * JavaScript. It stands on a canvas of the page, for which browsers keep lists of chips that they do not trust.
 */
export function openGl() {
  const plain = { alpha: false, antialias: false, depth: false, stencil: false };
  return document.createElement("canvas").getContext("webgl2", { ...plain, failIfMajorPerformanceCaveat: true });
}

export class PainterGl {
  name = "gl";

  /** Throws GlFault unless `gl` (null: there is none) draws what the formula says; calls `lost` when it goes away. */
  constructor(gl, lost) {
    if (!gl) throw new GlFault("this browser offers no WebGL2 on a chip");
    this.gl = gl;
    gl.canvas.addEventListener("webglcontextlost", lost);
    this.uniforms = this.#build();
    this.table = this.#texture(1);
    this.#prove();
  }

  /** Take a picture in, and look whether its middle row comes back: a chip may be right in small and wrong in large. */
  load(picture) {
    const { gl } = this;
    const { width, height } = picture;
    const texture = this.#texture(0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    const sheet = Object.assign(document.createElement("canvas"), { width, height });
    const plate = { texture, sheet, context: sheet.getContext("2d", { alpha: false }) };
    this.draw(plate, { redfree: false, table: toneTable(0, NEUTRAL) });
    compare(rowsOf(sheet, height >> 1, 1), rowsOf(picture, height >> 1, 1), "a whole picture");
    return plate;
  }

  /** The sheet with the picture as the tools make it. */
  draw({ texture, sheet, context }, { redfree, table }) {
    const { gl } = this;
    const { width, height } = sheet;
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
    if (gl.isContextLost() || error) throw new GlFault(gl.isContextLost() ? "it went away" : `WebGL error ${error}`);
    return sheet;
  }

  release({ texture, sheet }) {
    this.gl.deleteTexture(texture);
    sheet.width = sheet.height = 0;
    Object.assign(this.gl.canvas, { width: 1, height: 1 });
  }

  #build() {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new GlFault(`no shader: ${gl.getProgramInfoLog(program)}`);
    gl.useProgram(program);
    gl.uniform1i(gl.getUniformLocation(program, "picture"), 0);
    gl.uniform1i(gl.getUniformLocation(program, "table"), 1);
    return { redfree: gl.getUniformLocation(program, "redfree") };
  }

  #texture(unit) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, gl.NEAREST);
    for (const which of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, which, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Draw a picture of which every value is known, with each tool, all the way to the canvas, and compare. */
  #prove() {
    const known = knownPicture();
    const was = rowsOf(known, 0, PROOF_SIDE);
    const plate = this.load(known);
    for (const tools of PROOFS) {
      const table = toneTable(100, tools);
      const is = was.map((value, i) => (i % 4 === 3 ? 255 : table[tools.redfree ? was[i - (i % 4) + 1] : value]));
      const drawn = this.draw(plate, { redfree: tools.redfree, table });
      compare(rowsOf(drawn, 0, PROOF_SIDE), is, JSON.stringify(tools));
    }
    this.release(plate);
  }
}

function knownPicture() {
  const canvas = Object.assign(document.createElement("canvas"), { width: PROOF_SIDE, height: PROOF_SIDE });
  const context = canvas.getContext("2d");
  const pixels = context.createImageData(PROOF_SIDE, PROOF_SIDE);
  for (let i = 0; i < 256; i += 1) pixels.data.set([i, 255 - i, (i * 7) % 256, 255], 4 * i);
  context.putImageData(pixels, 0, 0);
  return canvas;
}

/** The values of some rows of a picture or canvas, as the page would see them. */
function rowsOf(source, first, count) {
  const canvas = Object.assign(document.createElement("canvas"), { width: source.width, height: count });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(source, 0, -first);
  return context.getImageData(0, 0, source.width, count).data;
}

function compare(got, wanted, what) {
  const at = wanted.findIndex((value, i) => Math.abs(got[i] - value) > OFF_BY);
  if (at >= 0) throw new GlFault(`it draws ${got[at]} instead of ${wanted[at]} (${what})`);
}
