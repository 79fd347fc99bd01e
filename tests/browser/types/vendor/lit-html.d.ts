// The parts of lit-html that the page uses: the published file has no types beside it.

export const nothing: unique symbol;
export const html: (strings: TemplateStringsArray, ...values: unknown[]) => object;
export const svg: typeof html;
export const render: (value: unknown, container: HTMLElement) => unknown;
