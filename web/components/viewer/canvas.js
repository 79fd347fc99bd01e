// Drawing of a picture on the viewer's canvas: position, interpolation, loupe.

import { clamp } from "../../core/viewport.js";

// Below 4 screen pixels per picture pixel, smoothing is on: without it, uneven pixel blocks would look like stripes.
// From 4 on, each picture pixel is a square. Smoothing there would draw edges between measured values that were not
// measured.
const SQUARE_MIN_SCALE = 4;
const LOUPE_ZOOM = 2.5; // magnification relative to the picture around it
const LOUPE_SHARE = 0.4; // diameter relative to the shorter side
const FINGER_CSS_PX = 40; // height above the touch point that a fingertip hides

/** Draw `shown`, `width` x `height` large, with its point (u, v), in picture widths from the centre, at `at`. */
export function drawPicture(context, shown, { u, v, width, height }, at = centreOf(context)) {
  const scale = width / shown.width;
  context.imageSmoothingEnabled = scale < SQUARE_MIN_SCALE;
  // Reduction needs the mean of all pixels; enlargement is bilinear, which does not overshoot.
  context.imageSmoothingQuality = scale < 1 ? "high" : "low";
  context.drawImage(shown, at.x - width / 2 - u * width, at.y - height / 2 - v * width, width, height);
}

/** Draw the loupe around its point; beside the finger if `loupe.held`. */
export function drawLoupe(context, shown, { u, v, width, height, loupe }) {
  const { width: wide, height: high } = context.canvas;
  const middle = centreOf(context);
  const unit = wide / context.canvas.clientWidth;
  const radius = (Math.min(wide, high) * LOUPE_SHARE) / 2;
  const point = { x: middle.x + (loupe.u - u) * width, y: middle.y + (loupe.v - v) * width };
  const at = loupe.held ? besideFinger(point, radius + FINGER_CSS_PX * unit, radius, middle) : point;
  const centre = { x: clamp(at.x, radius, wide - radius), y: clamp(at.y, radius, high - radius) };
  context.save();
  context.beginPath();
  context.arc(centre.x, centre.y, radius, 0, 2 * Math.PI);
  context.clip();
  context.fillStyle = "#000";
  context.fill();
  drawPicture(context, shown, { u: loupe.u, v: loupe.v, width: width * LOUPE_ZOOM, height: height * LOUPE_ZOOM }, centre);
  context.restore();
  frame(context, unit, () => context.arc(centre.x, centre.y, radius, 0, 2 * Math.PI));
}

const OVERVIEW_SHARE = 0.22; // side of the overview relative to the shorter side of the canvas
const OVERVIEW_MARGIN_CSS_PX = 12;

/**
 * Draw the whole picture small in the lower right corner, with a frame around the part that fills the canvas.
 * `width`, `height`, `side`: size on the canvas, in pixels, of the picture and of its part that is visible at zoom 1.
 */
export function drawOverview(context, shown, { u, v, width, height, side }) {
  const { width: wide, height: high } = context.canvas;
  const unit = wide / context.canvas.clientWidth;
  const small = Math.min(wide, high) * OVERVIEW_SHARE;
  const scale = small / side;
  const [left, top] = [wide, high].map((size) => size - small - OVERVIEW_MARGIN_CSS_PX * unit);
  context.save();
  context.beginPath();
  context.rect(left, top, small, small);
  context.clip();
  context.fillStyle = "#000";
  context.fill();
  const middle = { x: left + small / 2, y: top + small / 2 };
  drawPicture(context, shown, { u: 0, v: 0, width: width * scale, height: height * scale }, middle);
  const corner = { x: middle.x + (u * width - wide / 2) * scale, y: middle.y + (v * width - high / 2) * scale };
  frame(context, unit, () => context.rect(corner.x, corner.y, wide * scale, high * scale));
  context.restore();
  frame(context, unit, () => context.rect(left, top, small, small));
}

// White on black is visible on every picture.
function frame(context, unit, outline) {
  for (const [colour, line] of /** @type {[string, number][]} */ ([["#000", 5], ["#fff", 2]])) {
    context.strokeStyle = colour;
    context.lineWidth = line * unit;
    context.beginPath();
    outline();
    context.stroke();
  }
}

// Above the finger; without space there, on the side with more space.
function besideFinger({ x, y }, away, radius, middle) {
  if (y - away >= radius) return { x, y: y - away };
  return { x: x > middle.x ? x - away : x + away, y };
}

const centreOf = ({ canvas }) => ({ x: canvas.width / 2, y: canvas.height / 2 });
