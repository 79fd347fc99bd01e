// Renderer on the 2-D canvas: applies the lookup table to each pixel in JavaScript, three channels at once.

import { context2d } from "../../core/viewport.js";

/** Renderer that needs no graphics chip. */
export class Renderer2d {
  name = "2d";

  /** Read a picture as 32-bit pixels and create its output canvas. */
  load(picture) {
    const { width, height } = picture;
    const output = Object.assign(document.createElement("canvas"), { width, height });
    const context = context2d(output, { alpha: false, willReadFrequently: true });
    context.drawImage(picture, 0, 0);
    const from = context.getImageData(0, 0, width, height);
    const to = context.createImageData(width, height);
    return { output, context, from: new Uint32Array(from.data.buffer), to, into: new Uint32Array(to.data.buffer) };
  }

  /** Draw the picture with the tools on its output canvas. Every browser is little-endian: 0xAABBGGRR. */
  draw({ output, context, from, to, into }, { redfree, table }) {
    if (redfree) {
      const grey = Uint32Array.from(table, (value) => 0xff000000 | (value << 16) | (value << 8) | value);
      for (let i = 0; i < from.length; i += 1) into[i] = grey[(from[i] >> 8) & 255];
    } else {
      const green = Uint32Array.from(table, (value) => value << 8);
      const blue = Uint32Array.from(table, (value) => 0xff000000 | (value << 16));
      for (let i = 0; i < from.length; i += 1) {
        into[i] = blue[(from[i] >> 16) & 255] | green[(from[i] >> 8) & 255] | table[from[i] & 255];
      }
    }
    context.putImageData(to, 0, 0);
    return output;
  }

  /** Free the canvas memory at once, without waiting for the garbage collector. */
  release({ output }) {
    output.width = output.height = 0;
  }
}
