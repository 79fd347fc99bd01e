// What the page looks like for a given state: pure templates, no fetches, no decisions about the instrument.
// Never bind the `style` attribute (the CSP forbids it) and never build HTML from strings (Trusted Types forbid it).

import { html, nothing, svg } from "./vendor/lit-html.js";
import { calendarDay, clockTime, isToday, number, t } from "./words.js";

const EYES = ["OD", "OS"];

const PATHS = {
  ring: svg`<circle cx="12" cy="12" r="9" stroke-dasharray="4 2.6"></circle><circle cx="12" cy="12" r="1.5"></circle>`,
  hand: svg`<path
    d="M8 13V5.5a1.5 1.5 0 0 1 3 0V11M11 11V4a1.5 1.5 0 0 1 3 0v7M14 11V5.5a1.5 1.5 0 0 1 3 0V14c0 4-2.5 7-6 7
       -3 0-4.5-1.5-6-4l-1.7-3a1.5 1.5 0 0 1 2.5-1.6L8 15"></path>`,
  circle: svg`<circle cx="12" cy="12" r="9"></circle>`,
  check: svg`<path d="M4 12.5 9.5 18 20 6.5"></path>`,
  again: svg`<path d="M4 12a8 8 0 1 0 2.5-5.8M4 4v4.5h4.5"></path>`,
  next: svg`<path d="M5 12h14M13 6l6 6-6 6"></path>`,
  warn: svg`<path d="M12 4 2.5 20h19zM12 10v4.5M12 17.2v.3"></path>`,
  wait: svg`<circle cx="12" cy="12" r="9"></circle><path d="M12 7v5l3.5 2"></path>`,
  menu: svg`<path d="M4 7h16M4 12h16M4 17h16"></path>`,
  camera: svg`<circle cx="12" cy="13" r="3.5"></circle>
    <path d="M4 8h3.5L9 5.5h6L16.5 8H20a1 1 0 0 1 1 1v9a1 1 0 0 1-1 1H4a1 1 0 0 1-1-1V9a1 1 0 0 1 1-1z"></path>`,
  nolink: svg`<path
    d="M3 3l18 18M5 12.5a10 10 0 0 1 4-2.4M15.5 10.3a10 10 0 0 1 3.5 2.2M8.5 16a5 5 0 0 1 7 0M12 19.5v.1"></path>`,
};

export function page(state, act) {
  return html`
    <div class="page" data-screen=${state.screen} data-link=${state.link}>
      ${header(state, act)}
      <main class="stage-area" aria-label=${t("part.live")}>
        <div class="stage" data-mark=${state.picture}>
          <eye-live
            class=${state.picture === "none" ? "" : "behind"}
            .head=${state.status}
            .link=${state.link}
            .active=${state.screen === "aim"}
          ></eye-live>
          <eye-pic
            class=${state.picture === "none" ? "behind" : ""}
            tabindex=${state.picture === "none" ? "-1" : "0"}
            aria-label=${pictureName(state)}
            .head=${state.status}
            .subject=${state.subject}
            .redfree=${state.redfree}
            .contrast=${state.contrast}
            .src=${state.src}
            @drawn=${act.drawn}
            @fault=${act.pictureFault}
            @zoomed=${act.zoomed}
          ></eye-pic>
        </div>
        ${prompt(state)}
      </main>
      <section class="panel" aria-label=${t("part.controls")}>
        ${alertCard(state, act)} ${state.screen === "aim" ? eyes(state, act) : card(state)}
        ${state.picture === "none" ? nothing : tools(state, act)} ${actions(state, act)} ${strip(state, act)}
      </section>
      ${menu(state, act)}
    </div>
  `;
}

// ---- header

function header({ status, link, doing, shown }, act) {
  const kind = shown?.simulated ? "simulated" : status?.kind;
  const word = link === "live" ? doing : link;
  return html`
    <header>
      <h1>${t("app.name")}</h1>
      <p class="head-name">
        ${status?.name ?? ""} <span class="state" data-state=${word}>${t(`state.${word}`)}</span>
      </p>
      ${kindChip(kind)}
      <button class="quiet" type="button" @click=${act.openMenu}>${icon("menu")} ${t("menu")}</button>
      ${link === "lost" ? banner(kind) : nothing}
    </header>
  `;
}

function banner(kind) {
  return html`<div class="banner">${icon("nolink")} <p role="alert">${t("link.lost")}</p> ${kindChip(kind)}</div>`;
}

// What is not a real eye must be unmistakable on every screen, also when a picture's own mark is zoomed out of view.
// A kept picture answers for itself: it may come from another head than today's.
function kindChip(kind) {
  if (kind !== "simulated" && kind !== "recording") return nothing;
  return html`<p class="chip" title=${t(`chip.${kind}.why`)}>${t(`chip.${kind}`)}</p>`;
}

// ---- the line under the picture: what to do now, or what this picture is

function prompt(state) {
  const [tone, name, text] = promptOf(state);
  return html`<p class="prompt" role="status" data-tone=${tone}>${icon(name)} <span>${text}</span></p>`;
}

function promptOf({ screen, doing, stage, picture, shown, note }) {
  if (note) return ["wait", "wait", note];
  if (screen === "aim") {
    return doing === "aim" ? ["plain", "ring", t("aim.prompt")] : ["wait", "wait", t(`aim.${doing}`)];
  }
  if (screen === "making") {
    if (picture === "quick") return ["quick", "wait", t("mark.quick")];
    return stage.name === "expose" ? ["hold", "hand", t("make.expose")] : ["wait", "wait", t("make.refine")];
  }
  if (picture === "quick") return ["quick", "wait", t("mark.quick")];
  if (picture === "none" || !shown) return ["wait", "wait", t("mark.opening")];
  return ["done", "check", t("mark.final")];
}

function pictureName({ picture, shown, eye }) {
  if (picture === "none") return t("pic.none");
  const when = shown ? clockTime(shown.taken_at) : "";
  return t("pic.name", { mark: t(`mark.${picture}`), eye: t(`eye.${shown?.eye ?? eye}`), time: when });
}

// ---- panel

function alertCard({ alert }, act) {
  if (!alert) return nothing;
  return html`
    <div class="alert" role="alert" data-code=${alert.code}>
      ${icon("warn")}
      <p><strong>${alert.message}</strong> ${alert.remedy}</p>
      <button type="button" @click=${act.closeAlert}>${t("alert.close")}</button>
    </div>
  `;
}

function eyes({ eye }, act) {
  return html`
    <div class="eyes" role="group" aria-label=${t("eye.choose")}>
      ${EYES.map(
        (one) => html`
          <button type="button" data-eye=${one} aria-pressed=${one === eye} @click=${() => act.chooseEye(one)}>
            ${icon(one === eye ? "check" : "circle")} <span>${t(`eye.${one}`)}</span>
          </button>
        `,
      )}
    </div>
  `;
}

function card(state) {
  return state.screen === "making" ? makingCard(state) : resultCard(state);
}

function makingCard({ stage }) {
  const left = Math.round(stage.left); // 0: not known, and then nothing is promised
  const words = { expose: "make.expose", keep: "make.keep" };
  const promise = left >= 1 ? t("make.left", { n: left }) : stage.fraction >= 0.9 ? t("make.soon") : "\u00a0";
  return html`
    <div class="card making">
      <h2>${t(words[stage.name] ?? "make.refine")}</h2>
      <p class="muted">${promise}</p>
      <progress max="1" .value=${stage.fraction} aria-label=${t("make.progress")}></progress>
    </div>
  `;
}

function resultCard({ shown, eye, grey }) {
  return html`
    <div class="card">
      <h2 tabindex="-1" id="result-title">${t("result.title", { eye: t(`eye.${shown?.eye ?? eye}`) })}</h2>
      ${shown ? html`<p class="muted">${takenWords(shown.taken_at)}</p>` : nothing}
      ${(shown?.report?.warnings ?? []).map((warning) => html`<p class="warning">${icon("warn")} ${warning}</p>`)}
      ${shown ? details(shown, grey) : nothing}
    </div>
  `;
}

const takenWords = (moment) =>
  isToday(moment) ? clockTime(moment) : `${calendarDay(moment)}, ${clockTime(moment)}`;

// For the technician: how the picture was made, and the files to take away.
function details({ id, report, calibration_id: calibration, links }, grey) {
  const total = Object.values(report.seconds ?? {}).reduce((sum, part) => sum + part, 0);
  const rows = [
    ["method", report.method],
    ["rounds", report.rounds],
    ["stopped", report.stopped],
    ["seconds", t("detail.seconds.value", { s: number(total, 2) })],
    ["calibration", calibration],
    ["id", id],
  ];
  return html`
    <details>
      <summary>${t("result.details")}</summary>
      ${grey ? html`<p class="muted">${t("result.grey")}</p>` : nothing}
      <dl>${rows.map(([key, value]) => html`<dt>${t(`detail.${key}`)}</dt><dd>${value}</dd>`)}</dl>
      <p class="links">
        ${["picture", "raw", "report"].map((key) => html`<a href=${links[key]} download>${t(`detail.${key}`)}</a>`)}
      </p>
    </details>
  `;
}

function tools({ redfree, contrast, zoom, grey }, act) {
  const step = (less, more, label, lessName, moreName) => html`
    <div class="step" role="group" aria-label=${label}>
      <button type="button" aria-label=${lessName} @click=${less}>−</button>
      <span aria-hidden="true">${label}</span>
      <button type="button" aria-label=${moreName} @click=${more}>+</button>
    </div>
  `;
  const sign = contrast > 0 ? "+" : "−";
  const contrastWord = t("tool.contrast") + (contrast ? ` ${sign}${Math.abs(contrast)}` : "");
  const soften = () => act.contrastBy(-1);
  const harden = () => act.contrastBy(1);
  return html`
    <div class="tools" role="group" aria-label=${t("part.tools")}>
      <div class="pair">
        ${[false, true].map(
          (on) => html`<button type="button" aria-pressed=${on === redfree} @click=${() => act.setRedfree(on)}>
            ${t(on ? "tool.redfree" : grey ? "tool.plain" : "tool.colour")}
          </button>`,
        )}
      </div>
      ${step(soften, harden, contrastWord, t("tool.contrast.less"), t("tool.contrast.more"))}
      ${step(act.zoomOut, act.zoomIn, t("tool.zoom", { z: number(zoom) }), t("tool.zoom.less"), t("tool.zoom.more"))}
      <button class="reset" type="button" @click=${act.reset}>${t("tool.reset")}</button>
    </div>
  `;
}

function strip({ captures, screen, shown }, act) {
  if (!captures.length) return html`<p class="strip muted">${t("strip.empty")}</p>`;
  return html`
    <nav class="strip" aria-label=${t("part.strip")}>
      <ul>
        ${captures.map((capture) => {
          const time = clockTime(capture.taken_at);
          const current = screen === "result" && shown?.id === capture.id;
          return html`
            <li>
              <button
                type="button"
                data-id=${capture.id}
                aria-current=${current ? "true" : "false"}
                aria-disabled=${screen === "making"}
                aria-label=${t("strip.open", { eye: t(`eye.${capture.eye}.short`), time })}
                @click=${() => act.open(capture)}
              >
                <span class="thumb">
                  <img src=${capture.links.quick} alt="" loading="lazy" @load=${act.thumbLoaded} />
                </span>
                <span>${t(`eye.${capture.eye}.short`)} <br />${time}</span>
              </button>
            </li>
          `;
        })}
      </ul>
    </nav>
  `;
}

function actions(state, act) {
  const { screen, eye, fresh, stage, picture, link } = state;
  if (screen === "result" && !fresh) {
    return html`<div class="actions">
      <button class="primary" type="button" id="back" @click=${act.back}>${icon("next")} ${t("result.back")}</button>
    </div>`;
  }
  if (screen === "result") {
    return html`<div class="actions">
      <button type="button" id="again" @click=${act.again}>${icon("again")} ${t("result.again")}</button>
      <button class="primary" type="button" id="next" @click=${act.next}>
        ${icon("next")} <span>${t("result.next")}<small>${t(`eye.${otherEye(eye)}`)}</small></span>
      </button>
    </div>`;
  }
  const [name, word] = shutterFace(screen === "making", link, stage, picture);
  return html`<div class="actions">
    <button class="primary shutter" type="button" id="shutter" aria-disabled=${name !== "camera"} @click=${act.take}>
      ${icon(name)} <span>${t(word)}<small>${t(`eye.${eye}`)}</small></span>
    </button>
  </div>`;
}

// A shutter that cannot be pressed says why, in itself.
function shutterFace(making, link, stage, picture) {
  if (making) return stage.name === "expose" && picture === "none" ? ["hand", "take.hold"] : ["wait", "take.making"];
  return link === "lost" ? ["nolink", "take.lost"] : ["camera", "take"];
}

export const otherEye = (eye) => (eye === "OD" ? "OS" : "OD");

// ---- menu

function menu({ theme, letters, status }, act) {
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
      <h3>${t("menu.keys")}</h3>
      <label><input type="checkbox" .checked=${letters} @change=${act.setLetters} /> ${t("menu.letters")}</label>
      <dl>
        ${["take", "g", "contrast", "zero", "rn"].map(
          (key) => html`<dt>${t(`key.${key}`)}</dt><dd>${t(`key.${key}.what`)}</dd>`,
        )}
      </dl>
      <p><a href="/technician">${t("menu.technician")}</a></p>
      <p class="muted">${t("app.name")} · ${status ? t("menu.version", { version: status.version }) : ""}</p>
      <button class="primary" type="button" @click=${act.closeMenu}>${t("menu.close")}</button>
    </dialog>
  `;
}

// ---- icons: a few lines each, drawn here so that nothing is fetched. An icon never stands without its word, and is
// hidden from screen readers because the word says the same.

function icon(name) {
  return html`<svg class="icon" viewBox="0 0 24 24" aria-hidden="true" focusable="false">${PATHS[name]}</svg>`;
}
