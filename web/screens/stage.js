// The stage: the live picture and the taken one in the same place, so that nothing jumps; and the one line under it.

import { icon } from "../icons.js";
import { allowsLight, consentOf, eyeOf, shotOf } from "../memory.js";
import { slotWords, standing, stateBar } from "../parts.js";
import { html } from "../vendor/lit-html.js";
import { clockTime, has, t } from "../words.js";

export const isExam = ({ route }) => route.screen === "aim" || route.screen === "picture";

export function stage(state, act) {
  const shot = shotOf(state);
  const none = state.picture === "none" || !shot;
  return html`
    <section class="stage-area" aria-label=${t("part.live")} ?hidden=${!isExam(state)}>
      <div class="stage" data-mark=${none ? "none" : state.picture}>
        <eye-live
          class=${none ? "" : "behind"}
          .head=${state.status}
          .link=${state.link}
          .eye=${eyeOf(state, state.route.slot)}
          .visit=${allowsLight(state) ? state.route.visit : null}
          .hint=${standing(state) ? null : state.prompt}
          .active=${state.route.screen === "aim" && allowsLight(state)}
          @refused=${act.heardRefused}
          @aim=${act.heardAim}
          @late=${act.heardLate}
        ></eye-live>
        <eye-pic
          id="picture"
          class=${none ? "behind" : ""}
          tabindex=${none ? "-1" : "0"}
          aria-label=${pictureName(state, shot)}
          .head=${state.status}
          .subject=${shot?.key ?? null}
          .redfree=${state.redfree}
          .brightness=${state.brightness}
          .contrast=${state.contrast}
          .loupe=${state.loupe}
          .src=${sourceOf(shot)}
          @drawn=${act.drawn}
          @fault=${act.pictureFault}
          @zoomed=${act.zoomed}
          @loupe=${act.heardLoupe}
        ></eye-pic>
      </div>
      ${isExam(state) ? prompt(state, act) : ""}
    </section>
  `;
}

function sourceOf(shot) {
  if (shot?.capture) return { url: shot.capture.links.picture, mark: "final" };
  return shot?.quick ? { url: shot.quick, mark: "quick" } : null;
}

// ---- the line under the picture: what to do now, or what this picture is, or what stops

function prompt(state, act) {
  const stop = standing(state);
  const [tone, name, text] = stop ? ["stop"] : promptOf(state);
  const { eye, part } = slotWords(state, state.route.slot);
  const title = state.route.screen === "picture" && eye ? html`<b class="title">${eye} · ${part}</b> ` : "";
  return html`<div class="prompt" role="status" data-tone=${tone}>
    ${stop ? stateBar(stop, act) : html`${icon(name)} <span>${title}${text}</span>`}
  </div>`;
}

const HINTS = {
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

function promptOf(state) {
  const { route, note, doing, prompt: hint } = state;
  if (note) return ["wait", "wait", note];
  if (route.screen === "picture") return markOf(state);
  if (state.visit && consentOf(state.visit) === "saving") return ["wait", "wait", t("save.waiting")];
  if (doing === "starting") return ["wait", "wait", t("aim.starting")];
  if (doing !== "aim" && doing !== "making") return ["wait", "wait", t("aim.busy")];
  if (!hint || !has(`aim.${hint.code}`)) return ["plain", "ring", t("aim.prompt")];
  return [hint.code === "ready" ? "ready" : "plain", HINTS[hint.code] ?? "ring", t(`aim.${hint.code}`)];
}

function markOf(state) {
  const shot = shotOf(state);
  if (state.picture === "quick") return ["quick", "wait", t("mark.quick")];
  if (state.picture === "final") return ["done", "check", t("mark.final")];
  if (!shot || shot.capture) return ["wait", "wait", t("mark.opening")];
  return shot.stage.name === "expose" && !shot.verdict ? ["hold", "hand", t("make.expose")] : ["wait", "wait", t("make.refine")];
}

function pictureName(state, shot) {
  if (!shot || state.picture === "none") return t("pic.none");
  const time = shot.capture ? clockTime(shot.capture.taken_at) : "";
  const { eye, part } = slotWords(state, shot.slot);
  return t("pic.name", { mark: t(`mark.${state.picture}`), eye: eye || t(`eye.${eyeOf(state, shot.slot)}`), part, time });
}
