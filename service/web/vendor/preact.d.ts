// Types of preact.js: those of preact, which has some more.
import type { VNode } from "preact";

export { Component, createContext, h, render } from "preact";
export * from "preact/hooks";
type Value = object | string | number | boolean | null | undefined | ((...about: any[]) => unknown);
export function html(strings: TemplateStringsArray, ...values: Value[]): VNode;
