// The frame around every screen: header, the place for states, menu. Pure templates: no fetches, no decisions.
// Never bind the `style` attribute (the CSP forbids it) and never build HTML from strings (Trusted Types forbid it).

import { icon } from "./icons.js";
import { shotOf } from "./memory.js";
import { chips, personWords, standing, stateBar } from "./parts.js";
import { aim } from "./screens/aim.js";
import { find, home } from "./screens/home.js";
import { outcome } from "./screens/outcome.js";
import { person } from "./screens/person.js";
import { picture } from "./screens/picture.js";
import { isExam, stage } from "./screens/stage.js";
import { html, nothing } from "./vendor/lit-html.js";
import { has, t } from "./words.js";

const PLENTY = 200; // weeks of screening

const SCREENS = { home, find, person, aim, picture, outcome };

export function page(state, act) {
  const { later, route } = state;
  const screen = (SCREENS[route.screen] ?? later.history?.[route.screen] ?? later.send?.[route.screen])?.(state, act) ?? nothing;
  const exam = isExam(state);
  return html`
    <div class="page" data-screen=${route.screen} data-phase=${phase(state)} data-link=${state.link}>
      ${header(state, act)}
      <main class=${exam ? "exam" : "sheet"}>
        ${stage(state, act)}
        ${exam
          ? html`<section class="panel" aria-label=${t("part.controls")}>${screen}</section>`
          : html`<div class="standing" role="status">${top(state, act)}</div>
              ${chips(state, act)} ${screen}`}
      </main>
      ${menu(state, act)} ${later.aloud?.sheet(state) ?? nothing}
    </div>
  `;
}

/** Of the picture screen: making, told (the verdict is there), kept. */
function phase(state) {
  const shot = shotOf(state);
  if (!shot) return "";
  return shot.over ? "kept" : shot.verdict ? "told" : "making";
}

function top(state, act) {
  const stop = standing(state);
  return stop ? stateBar(stop, act) : nothing;
}

// ---- header

function header(state, act) {
  const { status, link, route, visit } = state;
  const word = link === "live" ? doingOf(state) : link;
  const space = status?.people_left;
  return html`
    <header>
      ${route.screen === "home"
        ? nothing
        : html`<button class="quiet" type="button" id="back" @click=${act.back}>${icon("left")} ${t("back")}</button>`}
      ${title(route, visit, act)}
      <p class="head-name">
        <span class="name">${status?.name ?? ""}</span>
        <span class="state" data-state=${word}>${t(has(`doing.${word}`) ? `doing.${word}` : "doing.busy")}</span>
        ${space === undefined || space === null ? nothing : html`<span class="space">${room(space)}</span>`}
      </p>
      ${kindChip(shotOf(state)?.capture?.simulated ? "simulated" : status?.kind)}
      <button class="quiet" type="button" id="open-menu" @click=${act.openMenu}>${icon("menu")} ${t("menu")}</button>
    </header>
  `;
}

// A number is told when it matters: one of thousands changes with every picture, and nobody plans by it.
const room = (people) => t(people > PLENTY ? "space.plenty" : "space", { n: people > 50 ? Math.floor(people / 10) * 10 : people });
// With two pictures in the making the instrument is busy, but nobody has to hold still any more.
function doingOf({ doing, shots }) {
  const own = shots.filter((shot) => !shot.over);
  return doing === "busy" && own.length && own.every((shot) => shot.verdict) ? "making" : doing;
}

function title(route, visit, act) {
  if (!route.visit || !visit) return html`<h1>${t("app.name")}</h1>`;
  const words = personWords(visit);
  if (route.screen !== "aim" && route.screen !== "picture") return html`<h1>${words}</h1>`;
  return html`<h1>
    <button class="quiet" type="button" id="who" @click=${() => act.go({ screen: "person", visit: visit.id })}>${words}</button>
  </h1>`;
}

// What is not a real eye must be unmistakable on every screen, also when a picture's own mark is zoomed out of view.
// A kept picture answers for itself: it may come from another head than today's.
function kindChip(kind) {
  if (kind !== "simulated" && kind !== "recording") return nothing;
  return html`<p class="chip" title=${t(`chip.${kind}.why`)}>${t(`chip.${kind}`)}</p>`;
}

// ---- menu

function menu({ theme, letters, auto, sound, status }, act) {
  return html`
    <dialog id="menu" aria-labelledby="menu-title">
      <h2 id="menu-title">${t("menu")}</h2>
      <h3 id="menu-theme">${t("menu.theme")}</h3>
      <div class="pair" role="group" aria-labelledby="menu-theme">
        ${["dim", "daylight"].map(
          (one) => html`<button type="button" aria-pressed=${one === theme} @click=${() => act.setTheme(one)}>
            ${t(`theme.${one}`)}
          </button>`,
        )}
      </div>
      <label><input type="checkbox" id="auto" .checked=${auto} @change=${act.setAuto} /> ${t("menu.auto")}</label>
      <label><input type="checkbox" id="sound" .checked=${sound} @change=${act.setSound} /> ${t("menu.sound")}</label>
      <details>
        <summary>${t("menu.keys")}</summary>
        <label><input type="checkbox" id="letters" .checked=${letters} @change=${act.setLetters} /> ${t("menu.letters")}</label>
        <dl>
          ${["take", "tiles", "g", "l", "brightness", "contrast", "zero", "rn"].map(
            (key) => html`<dt>${t(`key.${key}`)}</dt><dd>${t(`key.${key}.what`)}</dd>`,
          )}
        </dl>
      </details>
      <a class="button" href="/technician">${t("menu.technician")}</a>
      <p class="muted">${t("app.name")} · ${status ? t("menu.version", { version: status.version }) : ""}</p>
      <button class="primary" type="button" @click=${act.closeMenu}>${t("menu.close")}</button>
    </dialog>
  `;
}
