// Health report as text for support: copy, save as a file, or QR code.

import { html, nothing, svg } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

/** One line per check, below the instrument's name, version and time. */
export function reportText({ checks }, { name, version }, renderer, now = new Date()) {
  const lines = checks.map(({ ok, known, name: what, value }) => `${ok ? (known ? "ok" : "not known") : "BAD"}  ${t(`health.${what}`)}: ${value}`);
  return [`${name}, Diffuscope ${version}, ${now.toISOString().slice(0, 16)}Z`, ...lines, `${t("health.painter")}: ${renderer}`].join("\n");
}

/** Copy by selection and execCommand, which works without HTTPS. */
export function copyText(area) {
  area.select();
  return document.execCommand("copy");
}

/** Offer a text as a file to download. */
export function save(text, name = "health.txt") {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/plain" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

export function reportPanel({ text, code, message }, actions) {
  return html`<section class="report">
    <h3>${t("report.title")}</h3>
    <div class="row">
      <button type="button" id="report-copy" @click=${actions.copy}>${t("report.copy")}</button>
      <button type="button" id="report-save" @click=${actions.save}>${t("report.save")}</button>
      <button type="button" id="report-code" aria-expanded=${Boolean(code)} @click=${actions.code}>${t("report.code")}</button>
    </div>
    <p role="note">${message}</p>
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
