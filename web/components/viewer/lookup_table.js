// Brightness lookup table of 256 entries for the image tools. Both renderers use the same table, so their pictures are
// equal.

import { context2d } from "../../core/viewport.js";

const CONTRAST_STEP = 1.25; // contrast: slope factor per step
const BRIGHTNESS_STEP = 1.2; // brightness: exponent factor per step; black and white stay fixed
const ANALYSIS_SIDE = 256;
const LIT_MIN = 12; // of 255; darker pixels are outside the illuminated disc
const GREY_TOLERANCE = 8;

export const NEUTRAL = Object.freeze({ redfree: false, brightness: 0, contrast: 0 });

export const sameTools = (a, b) =>
  a.redfree === b.redfree && a.brightness === b.brightness && a.contrast === b.contrast;

/**
 * Return the output value of each of the 256 input values: contrast changes the slope about `pivot`, the mean of the
 * illuminated pixels, so that a dark retina is not clipped; then brightness applies a power law with fixed ends.
 */
export function lookupTable(pivot, { brightness, contrast }) {
  const slope = CONTRAST_STEP ** contrast;
  const exponent = BRIGHTNESS_STEP ** -brightness;
  return Uint8ClampedArray.from({ length: 256 }, (_, value) => {
    const stretched = Math.min(Math.max(pivot + (value - pivot) * slope, 0), 255);
    return 255 * (stretched / 255) ** exponent;
  });
}

/** Return a canvas with the whole of `picture`, at most `side` pixels wide and high. */
export function downscaled(picture, side) {
  const scale = Math.min(1, side / Math.max(picture.width, picture.height));
  const canvas = document.createElement("canvas");
  Object.assign(canvas, { width: Math.round(picture.width * scale), height: Math.round(picture.height * scale) });
  const context = context2d(canvas, { willReadFrequently: true, alpha: false });
  context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  return canvas;
}

/** Return the mean green value of the illuminated pixels (`pivot`) and whether the picture is grey. */
export function analyse(picture) {
  const copy = downscaled(picture, ANALYSIS_SIDE);
  const { data } = context2d(copy).getImageData(0, 0, copy.width, copy.height);
  let sum = 0;
  let count = 1;
  let grey = true;
  for (let i = 0; i < data.length; i += 4) {
    const green = data[i + 1];
    if (green > LIT_MIN) {
      sum += green;
      count += 1;
    }
    if (Math.abs(data[i] - green) > GREY_TOLERANCE || Math.abs(data[i + 2] - green) > GREY_TOLERANCE) grey = false;
  }
  return { pivot: sum / count, grey };
}
