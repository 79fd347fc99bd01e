// The state of the instrument as a text for whoever is asked for help: to copy, to save as a file, or as a code.

import { html, nothing, svg } from "./vendor/lit-html.js";
import { t } from "./words.js";

/** One line for each check, with the instrument's name, version and moment above. */
export function reportOf({ checks }, { name, version }, painter, now = new Date()) {
  const lines = checks.map(({ ok, known, name: what, value }) => `${ok ? (known ? "ok" : "not known") : "BAD"}  ${t(`health.${what}`)}: ${value}`);
  return [`${name}, Diffuscope ${version}, ${now.toISOString().slice(0, 16)}Z`, ...lines, `${t("health.painter")}: ${painter}`].join("\n");
}

/** Copies by what plain http allows: a marked text and the browser's own copying. */
export function copied(area) {
  area.select();
  return document.execCommand("copy");
}

export function save(text) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/plain" }));
  link.download = "health.txt";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

export function report({ text, code, said }, act) {
  return html`<section class="report">
    <h3>${t("report.title")}</h3>
    <div class="row">
      <button type="button" id="report-copy" @click=${act.copy}>${t("report.copy")}</button>
      <button type="button" id="report-save" @click=${act.save}>${t("report.save")}</button>
      <button type="button" id="report-code" aria-expanded=${Boolean(code)} @click=${act.code}>${t("report.code")}</button>
    </div>
    <p role="note">${said}</p>
    <textarea readonly rows="12" aria-label=${t("report.title")} .value=${text}></textarea>
    ${code
      ? html`<figure class="code">
          <svg viewBox=${`-4 -4 ${code.size + 8} ${code.size + 8}`} role="img" aria-label=${t("report.code.name")} shape-rendering="crispEdges">
            ${svg`<rect x="-4" y="-4" width=${code.size + 8} height=${code.size + 8} fill="#fff"></rect><path d=${code.path} fill="#000"></path>`}
          </svg>
        </figure>`
      : nothing}
  </section>`;
}
