export const generate: any;
export const correction: any;
