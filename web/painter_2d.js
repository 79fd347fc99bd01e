// The painter without a graphics chip: every pixel goes through the table in JavaScript, red, green and blue at once.

export class Painter2d {
  name = "2d";

  /** Take a picture in: its pixels as numbers of 32 bits, and the sheet that it is drawn on. */
  load(picture) {
    const { width, height } = picture;
    const sheet = Object.assign(document.createElement("canvas"), { width, height });
    const context = sheet.getContext("2d", { alpha: false, willReadFrequently: true });
    context.drawImage(picture, 0, 0);
    const from = context.getImageData(0, 0, width, height);
    const to = context.createImageData(width, height);
    return { sheet, context, from: new Uint32Array(from.data.buffer), to, into: new Uint32Array(to.data.buffer) };
  }

  /** The sheet with the picture as the tools make it. Every machine with a browser is little-endian: 0xAABBGGRR. */
  draw({ sheet, context, from, to, into }, { redfree, table }) {
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
    return sheet;
  }

  /** Give the memory back at once; a canvas is otherwise kept until somebody collects it. */
  release({ sheet }) {
    sheet.width = sheet.height = 0;
  }
}
