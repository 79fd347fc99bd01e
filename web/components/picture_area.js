// Picture area: live preview and taken picture in the same place, without layout shift, and the prompt line below.

import { icon } from "./icons.js";
import { colourLink, finalPicture } from "../core/api.js";
import { alertText } from "../core/alerts.js";
import { allowsLight, consentOf, eyeOf, currentCapture } from "../core/state.js";
import { chips, madeText, slotLabel, standing, topAlert, alertBar, versionName, whyGreen } from "./components.js";
import { html } from "../vendor/lit-html.js";
import { clockTime, has, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

export const isExamScreen = ({ route }) => route.screen === "aim" || route.screen === "picture";

/**
 * The visit that live pictures are requested for: the present one, if its consent and the control lease permit light.
 * @param {State} state
 */
const litVisit = (state) => (state.hasControl && allowsLight(state) ? state.route.visit : null);

/**
 * Live preview, picture viewer and prompt line; hidden outside the exam screens.
 * @param {State} state
 */
export function pictureArea(state, actions) {
  const capture = currentCapture(state);
  const none = state.picture === "none" || !capture;
  return html`
    <section class="stage-area" aria-label=${t("part.live")} ?hidden=${!isExamScreen(state)}>
      <div class="stage" data-mark=${none ? "none" : state.picture}>
        <eye-live
          class=${none && !state.asking ? "" : "behind"}
          .head=${state.status}
          .link=${state.link}
          .eye=${eyeOf(state, state.route.slot)}
          .visit=${litVisit(state)}
          .hint=${topAlert(state) ? null : state.prompt}
          .active=${state.route.screen === "aim" && !state.asking && litVisit(state) !== null}
          @refused=${actions.previewRefused}
          @aim=${actions.previewAim}
          @late=${actions.previewLate}
        ></eye-live>
        <eye-pic
          id="picture"
          class=${none ? "behind" : ""}
          tabindex=${none ? "-1" : "0"}
          aria-label=${pictureName(state, capture)}
          .head=${state.status}
          .subject=${capture?.key ?? null}
          .redfree=${state.redfree && !(capture?.record && colourLink(capture.record, state.version, state.visit))}
          .brightness=${state.brightness}
          .contrast=${state.contrast}
          .loupe=${state.loupe}
          .src=${sourceOf(capture, state)}
          @drawn=${actions.pictureDrawn}
          @fault=${actions.pictureFault}
          @zoomed=${actions.zoomed}
          @loupe=${actions.loupeChanged}
        ></eye-pic> ${none ? "" : made(state, capture)}
      </div> <p class="unseen" aria-live="polite">${announcement(state)}</p>
      ${isExamScreen(state) ? [prompt(state, actions), isAiming(state) ? "" : standing(state, actions), chips(state, actions)] : ""}
    </section>
  `;
}

/**
 * The time of a picture in the corner beside the round field; enlarged, the retina is there.
 * @param {State} state
 */
function made({ picture, version, zoom }, capture) {
  const text = picture === "final" && !version && zoom <= 1 && capture.record ? madeText(capture.record.report) : "";
  return text ? html`<p class="made">${text}</p>` : "";
}

/**
 * What a screen reader says after the page went on by itself.
 * @param {State} state
 */
function announcement(state) {
  const left = state.alerts.find(({ code }) => code === "shot.next");
  return left ? `${alertText(left)} ${t("result.next.field", slotLabel(state, state.route.slot))}` : "";
}

function sourceOf(capture, { redfree, version, visit }) {
  if (capture?.record) return finalPicture(capture.record, redfree, visit, version);
  return capture?.quick ? { url: capture.quick, mark: "quick" } : null;
}

// ---- prompt line: while aiming a blocking alert or the hint; else eye and field, which no alert replaces, and the mark

/** @param {State} state */
const isAiming = ({ route, asking }) => route.screen === "aim" && !asking;

/** @param {State} state */
function prompt(state, actions) {
  const stop = isAiming(state) ? topAlert(state) : null;
  const [tone, name, text] = stop ? ["stop"] : promptOf(state);
  const { eye, part } = slotLabel(state, state.route.slot);
  const title = !isAiming(state) && eye ? html`<b class="title">${eye} · ${part}</b> ` : "";
  return html`<div class="prompt" role="status" data-tone=${tone}>
    ${stop ? alertBar(stop, actions) : html`${icon(name)} <span>${title}${text}</span>`}
  </div>`;
}

const HINT_ICONS = {
  ready: "check",
  still: "hand",
  closer: "up",
  back: "down",
  left: "left",
  right: "next",
  up: "up",
  down: "down",
  dark: "sun",
  bright: "sun",
};

/** @param {State} state */
function promptOf(state) {
  const { route, note, activity, prompt: hint } = state;
  if (note) return ["wait", "wait", note];
  if (state.asking) return ["plain", "camera", ""];
  if (route.screen === "picture") return markPrompt(state);
  if (state.visit && consentOf(state.visit) === "saving") return ["wait", "wait", t("save.waiting")];
  if (activity === "starting") return ["wait", "wait", t("aim.starting")];
  if (activity !== "aim" && activity !== "making") return ["wait", "wait", t("aim.busy")];
  if (!hint || !has(`aim.${hint.code}`)) return ["plain", "ring", t("aim.prompt")];
  return [hint.code === "ready" ? "ready" : "plain", HINT_ICONS[hint.code] ?? "ring", t(`aim.${hint.code}`)];
}

const notes = (state, mark) => [t(mark), whyGreen(state.visit)].filter(Boolean).join(" · ");

/** @param {State} state */
function markPrompt(state) {
  const capture = currentCapture(state);
  if (capture?.stage.name === "expose" && !capture.verdict && !capture.record) return ["hold", "hand", t("make.expose")];
  if (state.picture === "quick") return ["quick", "wait", t("mark.quick")];
  if (state.picture === "final" && capture?.verdict?.word === "again" && !state.version) return ["plain", "pen", notes(state, "mark.final.again")];
  if (state.picture === "final" && state.version) return ["done", "check", t("version.note")];
  if (state.picture === "final") return ["done", "check", notes(state, "mark.final")];
  if (!capture || capture.record) return ["wait", "wait", t("mark.opening")];
  return ["wait", "wait", t("make.refine")];
}

/** @param {State} state */
function pictureName(state, capture) {
  if (!capture || state.picture === "none") return t("pic.none");
  const time = capture.record ? clockTime(capture.record.taken_at) : "";
  const { eye, part } = slotLabel(state, capture.slot);
  const shown = capture.record?.versions?.find(({ number }) => number === state.version);
  const mark = shown ? versionName(shown) : t(`mark.${state.picture}`);
  return t("pic.name", { mark, eye: eye || t(`eye.${eyeOf(state, capture.slot)}`), part, time });
}
