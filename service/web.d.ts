// What the page's modules hand to each other: read by tsc, not by browsers.

type Problem = import("./web/api.js").Problem;
type DepthReader = import("./web/reader.js").DepthReader;

interface RequestOptions {
	method?: string;
	headers?: Record<string, string>;
	body?: XMLHttpRequestBodyInit | null;
	signal?: AbortSignal;
	/** whether a missing key is asked for; false for what nobody has clicked for */
	asks?: boolean;
}
/** `onProgress` gets the part sent, 0 to 1, or null where it is unknown; `onReceived` that of the answer. */
interface UploadOptions extends RequestOptions {
	onProgress?: (fraction: number | null) => void;
	onReceived?: (fraction: number | null) => void;
	responseType?: "" | "blob" | "json";
}
type FieldProblem = { pointer: string; detail: string };
type KeyAsker = (reason: string | null) => Promise<string | null>;
type Question = { reason: string | null; answer: (key: string | null) => void };

type Tab = "depth" | "cameras" | "calibrate" | "status";
/** What every view gets. Views stay mounted when another is in front, so that nothing is lost. */
interface ViewProps {
	/** whether the view's tab is in front */
	shown: boolean;
	/** as the API gives them, by name; null before they are there */
	cameras: any[] | null;
	/** whether they could not be had */
	lacksCameras: boolean;
	/** the name in the address, for the view in front */
	camera: string | null;
	/** `stored` is among them even where that fails */
	reloadCameras: (about?: { stored?: any }) => Promise<void>;
	/** change the tab, and pick the camera there; the way back leads past an address that is replaced */
	go: (tab: Tab, about?: { camera?: string | null; replaces?: boolean }) => void;
	/** say it to who cannot see it */
	announce: (text: string) => void;
}

/** by the pointer's path: "lens/f_number" */
type Fields = Record<string, string>;
type Open = { kind: "none" } | { kind: "read"; name: string } | { kind: "new" } | { kind: "edit"; camera: any };
interface Step {
	camera: any;
	name: string;
	does: "create" | "update" | "nothing" | "refuse" | "done";
	words: string;
	revision: number | null;
}

type Pixel = { u: number; v: number };
type KnownDepth = Pixel & { depthM: number };
/** false where it is not known */
type Measured = { distanceM: number; sigmaM: number } | false;
type Phase =
	| { step: "upload" | "receive"; fraction: number | null }
	| { step: "work"; since: number }
	| { step: "draw" };
interface Result {
	asked: { camera: string; side: string; focusM: number | null; known: KnownDepth[] };
	file: File;
	facts: Facts;
	/** the focus distance that was used */
	focusM: number;
	/** of the camera */
	revision: number;
	warnings: string[];
	/** the service's stages in milliseconds */
	timings: [string, number][];
	model: string;
}
type Ask = { camera: string; side: string; focusM: number | null; known: KnownDepth[]; format: string };
type Command = { url: string; photograph: string; mediaType: string; answer: string; hasKey: boolean };

type NumpyArray = { data: Float32Array | Float64Array | Uint8Array; shape: number[] };
/** What is known at a pixel; null where there is no answer, or no other hypothesis. */
interface Reading extends Pixel {
	depthM: number | null;
	/** the depth on the other side of the plane in focus */
	otherM: number | null;
	sigmaM: number | null;
	pNear: number;
	blurPx: number;
	/**
	 * metres straight from the lens per metre of depth along its axis; null where the camera's focal length is not
	 * known, or no ray meets the pixel
	 */
	rayLength: number | null;
}
interface Facts {
	/** of the photograph, in whose pixels places are told */
	width: number;
	height: number;
	/** whether the camera's focal length is known, without which a pixel has no direction */
	hasPoints: boolean;
	validShare: number;
	/** the part of the pixels that could be on either side */
	eitherShare: number;
	/** least, 2 %, 98 % and greatest */
	spread: { leastM: number; nearM: number; farM: number; mostM: number } | null;
}
type MapName = "cividis" | "viridis" | "turbo" | "grey";
interface Look {
	map: MapName;
	nearM: number;
	farM: number;
	/** whether pixels without an answer are hatched */
	hatchesNothing: boolean;
	/** whether pixels that could be on either side are dotted */
	dotsEither: boolean;
}

type Points = { positions: Float32Array; colours: Uint8Array; centre: number[]; spacing: number };
/** One of the cloud's methods, and what it takes. */
type Order = ["show", Points] | ["resize" | "orbit", number, number] | ["zoom", number] | ["reset"];
type Tell = (order: Order, parts?: Transferable[]) => void;

/** The sheet as it is printed, numbers as they are typed; `ruler_mm` is what the printed ruler of 100 mm measures. */
interface Sheet {
	kind: string;
	rows: string;
	columns: string;
	spacing_mm: string;
	diameter_mm: string;
	paper: string;
	ruler_mm: string;
}
type Role = "focused" | "defocused";
/** `asked` is what the look, or the problem, answers: another pattern or camera asks anew. */
type Photo = { id: number; file: File; role: Role; asked: string; look: any | null; problem: Problem | null };
/** a photograph in which the grid was found */
interface Seen {
	role: Role;
	/** before EXIF orientation */
	width: number;
	height: number;
	/** of EXIF */
	orientation: number;
	circles: { u_px: number; v_px: number; radius_px: number }[];
	/** in px */
	blur: number | null;
	/** in metres */
	distance: number | null;
	/** in degrees */
	tilt: number | null;
}
type Between = [number, number];
/** what a calibration found, as its chart needs it */
type Fit = { samples: any[]; curve: any[]; focus_distance_m: any };

type Point = { x: number; y: number; low?: number; high?: number; label?: string };
/** `line` and `dots` draw the points, `band` what is between their `low` and `high`. */
type Series = { name: string; kind: "line" | "band" | "dots"; tone: string; points: Point[] };
type Axis = { label: string; unit: string; from?: number; to?: number; isLog?: boolean };
type Scale = { scale: (value: number) => number; ticks: number[] };

type Sample = { name: string; labels: Record<string, string>; value: number };
/** What one look found: a problem in the place of what could not be had, null where nobody has looked yet. */
interface Found {
	ready: any | Problem | null;
	model: any | Problem | null;
	samples: Sample[] | Problem | null;
	/** it looked with */
	key: string | null;
	at: Date | null;
}

// What the views' parts take.
/** `editing` is the camera as it was read, null for a new one */
interface CameraFormProps {
	editing: any | null;
	onSaved: (words: string, camera: any) => void;
	onTyped: () => void;
	onCancel: () => void;
}
interface FieldProps {
	path: string;
	label: string;
	value: string;
	form?: string;
	kind?: string;
	hint?: string;
	disabled?: boolean;
	faults: FieldProblem[];
	onChange: (changed: Fields) => void;
}
interface ConflictProps {
	base: any;
	theirs: any;
	fields: Fields;
	onMine: () => void;
	onTheirs: () => void;
}
/** `onStale` is for when the service has another revision */
interface CameraCardProps {
	camera: any;
	opened: Open;
	go: ViewProps["go"];
	onEdit: () => void;
	onDeleted: () => void;
	onStale: () => void;
}
interface DeleteDialogProps {
	camera: any;
	path: string;
	onClose: () => void;
	onDeleted: () => void;
	onStale: () => void;
}
/** `marks` are upright lines with a word */
interface ChartProps {
	title: string;
	x: Axis;
	y: Axis;
	series: Series[];
	marks?: { x: number; label: string }[];
}
interface CloudViewProps {
	reader: DepthReader;
	result: Result;
	look: Look;
	hasPhotograph: boolean;
	isShown: boolean;
}
interface BoundProps {
	title: string;
	value: number;
	leastM: number;
	mostM: number;
	onValue: (value: number) => void;
}
interface DraftFormProps {
	file: File;
	onStored: (camera: any) => Promise<void>;
	onFailed: (why: Problem) => void;
}
interface ExportsProps {
	result: Result;
	announce: (text: string) => void;
	onChanged: () => void;
}
interface EndedProps {
	job: any;
	cameras: any[] | null;
	onAccepted: (job: any) => void;
	onDiscard: () => void;
	onAgain: () => void;
	go: ViewProps["go"];
}
interface ConstantProps {
	name: string;
	unit: string;
	of: { value: number; low: number; high: number };
}
interface PhotographsProps {
	photos: Photo[];
	query: string;
	focus: number | null;
	onChange: (change: (before: Photo[]) => Photo[]) => void;
	announce: (text: string) => void;
}
interface PhotoCardProps {
	photo: Photo;
	isLooking: boolean;
	hasPartner: boolean;
	onRole: (role: Role) => void;
	onAgain: () => void;
	onRemove: () => void;
}
interface DistanceProps {
	marks: Pixel[];
	measured: Measured | null;
	hasPoints: boolean;
	onClear: () => void;
}
interface StageProps {
	reader: DepthReader;
	size: { width: number; height: number };
	look: Look;
	bitmap: ImageBitmap | null;
	result: Result | null;
	reading: Reading | null;
	marks: Pixel[];
	measured: Measured | null;
	known: KnownDepth[];
	onReading: (reading: Reading | null) => void;
	onMarks: (marks: Pixel[]) => void;
	onCounts: (counts: Uint32Array) => void;
	announce: (text: string) => void;
}
interface LabelProps {
	left: number;
	top: number;
	isBelow: boolean;
	name: string;
	children?: any;
}
interface FiguresProps {
	title: string;
	samples: Sample[] | Problem | null;
	Content: (props: { samples: Sample[] }) => any;
}
interface TapeProps {
	reader: DepthReader;
	mark: Pixel | null;
	hasPoints: boolean;
	known: KnownDepth[];
	onKnown: (known: KnownDepth[]) => void;
}
/** `onChange` is for when the typing is over; a fault has the `role` */
interface TextFieldProps {
	id: string;
	label: string;
	value: string;
	onInput: (value: string) => void;
	fault?: string;
	hint?: any;
	onChange?: (value: string) => void;
	kind?: string;
	list?: string;
	disabled?: boolean;
	invalid?: boolean;
	role?: string | null;
}
/** `options` are values and words */
interface ChoiceProps {
	label: string;
	value: string;
	options: string[][];
	onChange: (value: string) => void;
}
interface RecentProps {
	items: any[];
	open: string | null;
	onOpen: (id: string) => void;
}
interface SwitchProps {
	title: string;
	isOn: boolean;
	onSwitch: (isOn: boolean) => void;
}
interface DropPlaceProps {
	kind?: string;
	onFiles?: (files: File[]) => void;
	children?: any;
}
/** renders nothing where there is no problem, and offers `onRetry` only where that may help */
interface ProblemBoxProps {
	problem: Problem | null;
	onRetry?: () => void;
	onClose?: () => void;
}
interface SheetStepProps {
	sheet: Sheet;
	onChange: (sheet: Sheet) => void;
	onNext: () => void;
}
/** `numbers` are columns of numbers */
interface TableProps {
	label: string;
	head: string[];
	numbers?: number[];
	children?: any;
}
