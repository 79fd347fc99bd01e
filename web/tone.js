// What the tools do to a picture's values, as one table of 256 entries. Both painters look values up in the same table,
// so both make the same picture.

const CONTRAST_STEP = 1.25; // one step is a quarter more slope
const BRIGHTNESS_STEP = 1.2; // one step is a fifth more exponent: black stays black and white stays white
const STUDY_SIDE = 256;
const LIT = 12; // of 255: darker is outside the illuminated disc
const GREY = 8;

export const NEUTRAL = Object.freeze({ redfree: false, brightness: 0, contrast: 0 });

export const sameTools = (a, b) =>
  a.redfree === b.redfree && a.brightness === b.brightness && a.contrast === b.contrast;

/**
 * The new value of each of the 256 old ones. Contrast turns about `pivot`, the mean of what is lit, so that a dark retina
 * neither drowns nor burns out; then brightness bends the middle and leaves the ends.
 */
export function toneTable(pivot, { brightness, contrast }) {
  const slope = CONTRAST_STEP ** contrast;
  const bend = BRIGHTNESS_STEP ** -brightness;
  return Uint8ClampedArray.from({ length: 256 }, (_, value) => {
    const turned = Math.min(Math.max(pivot + (value - pivot) * slope, 0), 255);
    return 255 * (turned / 255) ** bend;
  });
}

/** A canvas of at most `side` pixels a side that shows all of `picture`. */
export function smallCopy(picture, side) {
  const scale = Math.min(1, side / Math.max(picture.width, picture.height));
  const canvas = document.createElement("canvas");
  Object.assign(canvas, { width: Math.round(picture.width * scale), height: Math.round(picture.height * scale) });
  const context = canvas.getContext("2d", { willReadFrequently: true, alpha: false });
  context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  return canvas;
}

/** What the tools must know of a picture: the mean green of what is lit, and whether it has colours at all. */
export function study(picture) {
  const copy = smallCopy(picture, STUDY_SIDE);
  const { data } = copy.getContext("2d").getImageData(0, 0, copy.width, copy.height);
  let sum = 0;
  let count = 1;
  let grey = true;
  for (let i = 0; i < data.length; i += 4) {
    const green = data[i + 1];
    if (green > LIT) {
      sum += green;
      count += 1;
    }
    if (Math.abs(data[i] - green) > GREY || Math.abs(data[i + 2] - green) > GREY) grey = false;
  }
  return { pivot: sum / count, grey };
}
